"""`playslot bench device=cuda` (`make test-gpu`)."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from playslot_rl.config.compose import compose
from playslot_rl.recipes import bench
from playslot_rl.speed import gpu

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")]


def test_every_case_is_timed_eager_and_captured(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bench.main(compose(["preset=smoke", "device=cuda"]), tmp_path / "gpu.json")
    figures = json.loads((tmp_path / "gpu.json").read_text())
    device = torch.device("cuda")
    for case in gpu.CASES:
        names = {f"smoke_{precision}_{way}" for precision, way in gpu.variants(case, "smoke", device)}
        assert {*figures[case]} == {*figures[f"{case}_memory"]} == {"unit", *names}
    assert "left out" not in capsys.readouterr().out
