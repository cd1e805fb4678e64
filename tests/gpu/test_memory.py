"""A batch that does not fit into a real GPU's memory: the one that is named does (`make test-gpu`)."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from playslot_rl.config import OptimConfig, StageConfig
from playslot_rl.config.compose import compose
from playslot_rl.errors import TrainingError
from playslot_rl.runtime.precision import PAYS, resolve_precision
from playslot_rl.runtime.shares import own_rows
from playslot_rl.seeds.draws import StepGenerators
from playslot_rl.speed.steps import precisions, time_step
from playslot_rl.training.fit import Part, fit
from playslot_rl.training.steps import WARM

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]

GIB = 2**30


def taken(left: int) -> Tensor:
    """All of the memory but so many bytes."""
    torch.cuda.empty_cache()
    return torch.empty(torch.cuda.mem_get_info()[0] - left, dtype=torch.uint8, device="cuda")


class Convolutions:
    """About 13 MiB a row are kept for the backward pass. After `full_at` steps hardly any memory is left."""

    def __init__(self, rows: int, full_at: int = -1) -> None:
        self.rows, self.full_at, self.full = rows, full_at, torch.empty(0)
        layers = [nn.Sequential(nn.Conv2d(16, 16, 3, padding=1), nn.GELU()) for _ in range(6)]
        self.modules: Mapping[str, nn.Module] = {"layers": nn.Sequential(*layers).cuda()}

    def batch(self, step: int, generators: StepGenerators) -> dict[str, Tensor]:
        if step == self.full_at and len(self.full) == 0:
            self.full = taken(GIB // 4)
        rows = own_rows(torch.arange(self.rows, device="cuda"))
        return {"x": torch.ones(len(rows), 16, 128, 128, device="cuda") * generators.numpy("x").normal()}

    def loss(self, batch: Mapping[str, Tensor], step: int, generators: StepGenerators) -> dict[str, Tensor]:
        return {"loss": self.modules["layers"](batch["x"]).square().mean()}

    def validate(self, step: int) -> dict[str, float]:
        return {}


def trained(stage: Convolutions, folder: Path, execution: str, accumulate: int = 1) -> None:
    config = StageConfig(steps=8, batch_size=stage.rows, optim=OptimConfig(accumulate=accumulate))
    part = Part("rows", stage, replace(config, execution=execution))  # type: ignore[arg-type]
    fit(part, folder, seed=3, device="cuda")


@pytest.mark.parametrize("execution", ["eager", "auto"])
def test_what_is_named_fits(tmp_path: Path, execution: str) -> None:
    full = taken(2 * GIB)
    with pytest.raises(TrainingError) as caught:
        trained(Convolutions(512), tmp_path / "large", execution)
    message = str(caught.value)
    found = re.search(r"expected at most (\d+): use it, or rows\.optim\.accumulate=(\d+)$", message)
    assert found is not None, message
    rows, micros = map(int, found.groups())
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    trained(Convolutions(rows), tmp_path / "fits", execution)
    peak = torch.cuda.max_memory_allocated() - before
    assert GIB <= peak <= 2 * GIB, "neither too many rows nor needlessly few"
    trained(Convolutions(512), tmp_path / "shares", execution, micros)
    assert len(full) > 0


def test_a_capture_that_runs_out_of_memory_names_the_batch_that_fits(tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match=r"^rows\.batch_size: got 64, which .*, expected at most \d+: use it, or"):
        trained(Convolutions(64, full_at=WARM), tmp_path, "auto")


def test_auto_is_the_precision_of_the_quicker_step() -> None:
    config, device = compose(["preset=paper", "env=button_press"]), torch.device("cuda")
    took = {kind: time_step(config, "slots", device, kind, batch=8)[0] for kind in precisions("cuda")}
    assert took[resolve_precision("auto", "cuda")] <= PAYS * min(took.values()), took
