"""What a training says of itself at its end."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from playslot_rl.config import StageConfig
from playslot_rl.methods.lapo.training import on_pairs
from playslot_rl.training.run_stage import on_clips


@pytest.mark.parametrize("validated", ["held-out", "training"])
def test_a_closing_line_says_which_clips_its_number_is_of(validated: str) -> None:
    """With a few episodes none is held out."""
    record: Any = SimpleNamespace(
        name="model", device="cpu", pace=None, folder=Path("runs/model"), data=SimpleNamespace(episodes=1)
    )
    stage: Any = SimpleNamespace(clips=SimpleNamespace(validated=validated))
    lines = [make(record, stage, StageConfig()).line({"unexplained": 0.5, "psnr": 20}) for make in (on_pairs, on_clips)]
    assert lines == [
        f"model: 50 % of the change left on {validated} pairs, runs/model",
        f"model: 20.00 dB on {validated} clips, runs/model",
    ]
