"""A batch that does not fit into a GPU ends in one line with the one that does."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from toy_stage import ToyStage, toy_config

from playslot_rl.errors import TrainingError
from playslot_rl.seeds.draws import StepGenerators
from playslot_rl.training import memory
from playslot_rl.training.fit import Part, fit
from playslot_rl.training.memory import fitting, out_of_memory

AT_LEAST, A_ROW, OF_THE_BATCH, FREE = 100.0, 100.0, 26, 30_000.0
"""Bytes; those of all rows of the batch come to what is computed from some."""
HELD = 269
"""Rows for which 90 % of what is free is enough."""


class Wide(ToyStage):
    """A stage that takes `HELD` rows, or fewer; more raise what torch raises."""

    def __init__(self, rows: int, held: int = HELD, norm: bool = False) -> None:
        super().__init__()
        self.rows, self.held, self.seen = rows, held, list[int]()
        normalised = nn.BatchNorm1d(4) if norm else nn.Identity()
        self.modules = {"encoder": nn.Sequential(nn.Linear(6, 4), normalised), "decoder": nn.Linear(4, 6)}

    def batch(self, step: int, generators: StepGenerators) -> dict[str, Tensor]:
        return {"x": torch.randn(self.rows, 6, generator=generators.torch("x")), "half": torch.ones(self.rows // 2)}

    def loss(self, batch: Mapping[str, Tensor], step: int, generators: StepGenerators) -> dict[str, Tensor]:
        x = batch["x"]
        self.seen.append(len(x))
        assert len(batch["half"]) == len(x) // 2
        if len(x) > self.held:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB.")
        return {"loss": (self.modules["decoder"](self.modules["encoder"](x)) - x).square().mean()}


def message(stage: Wide, folder: Path, monkeypatch: pytest.MonkeyPatch, accumulate: int = 1) -> str:
    """What a training of a stage ends with on a card where the peak is a straight line of the rows."""

    def peak(compute: Callable[[], None], _: torch.device) -> float:
        compute()
        return AT_LEAST + A_ROW * stage.seen[-1]

    monkeypatch.setattr(memory, "peak_memory", peak)
    monkeypatch.setattr(memory, "free_memory", lambda _: FREE + OF_THE_BATCH * stage.rows / 0.9)
    monkeypatch.setattr(memory, "device_memory", lambda _: "the 1 GiB of a toy")
    config = toy_config()
    config = replace(config, batch_size=stage.rows, optim=replace(config.optim, accumulate=accumulate))
    with pytest.raises(TrainingError) as caught:
        fit(Part("toy", stage, config), folder, seed=3)
    assert caught.value.__cause__ is caught.value.__context__ is None  # it would hold the failed step's tensors
    assert all(weight.grad is None for module in stage.modules.values() for weight in module.parameters())
    return str(caught.value)


TOO_LARGE = "toy.batch_size: got 512, which does not fit into the 1 GiB of a toy, expected"


def test_the_batch_that_fits_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stage = Wide(512)
    found = message(stage, tmp_path, monkeypatch)
    assert found == f"{TOO_LARGE} at most 256: use it, or toy.optim.accumulate=2"
    assert stage.seen == [512, 448, 384, 320, 256]
    named = Wide(256)
    fit(Part("toy", named, replace(toy_config(), batch_size=256)), tmp_path, seed=3)
    assert len(named.seen) == 12


def test_a_network_that_normalises_by_its_batch_is_not_told_to_accumulate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert message(Wide(512, norm=True), tmp_path, monkeypatch) == f"{TOO_LARGE} at most 256: use it"


def test_where_not_even_a_small_batch_fits_the_sizes_are_too_large(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = message(Wide(512, held=8), tmp_path, monkeypatch)
    assert found == f"{TOO_LARGE} one that does; a small one does not either: choose smaller sizes"


@pytest.mark.parametrize(
    ("rows", "line", "expected"),
    [(512, (100, 3), 256), (512, (901, 3), 0), (512, (100, 0), 448), (4, (0, 300), 3),
     (1, (0, 1), 0), (2, (0, 450), 1)],
)  # fmt: skip
def test_the_largest_part_whose_peak_fits_is_named(rows: int, line: tuple[float, float], expected: int) -> None:
    assert fitting(lambda b: line[0] + line[1] * b, rows, 1000) == expected


def test_a_capture_that_ended_for_want_of_memory_is_known() -> None:
    def raised(error: Exception, during: Exception) -> Exception:
        try:
            try:
                raise during
            finally:
                raise error
        except RuntimeError as caught:
            return caught

    late = RuntimeError("operation failed due to a previous error during capture")
    assert out_of_memory(raised(late, torch.OutOfMemoryError("CUDA out of memory")))
    assert not out_of_memory(raised(RuntimeError("illegal"), ValueError("batch")))


def test_micro_batches_are_made_smaller(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Shared(Wide):
        def batch(self, step: int, generators: StepGenerators) -> dict[str, Tensor]:
            from playslot_rl.runtime.shares import own_rows

            whole: dict[str, Any] = super().batch(step, generators)
            return {key: own_rows(value) for key, value in whole.items()}

    stage = Shared(2048)
    found = message(stage, tmp_path, monkeypatch, accumulate=2)
    assert found.endswith("expected at most 512: use it, or toy.optim.accumulate=8")
    assert stage.seen == [1024, 896, 768, 640, 512, 384, 256]
