"""Early stopping: it stops where the error no longer falls, keeps the best weights, and resumes as if never killed."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor, nn
from toy_stage import toy_config

from playslot_rl.errors import CheckpointError, TrainingError
from playslot_rl.seeds.draws import StepGenerators
from playslot_rl.storage.resume import TrainingState
from playslot_rl.training.fit import Part, fit
from playslot_rl.training.patience import Patience

ERRORS = (5.0, 3.0, 4.0, 2.0, 2.0, 6.0, 2.5, 1.0)
"""Of the validations after 4, 8, 12, ... steps: the fourth is the best until the eighth."""


class Counter:
    """One weight that counts its steps; its held-out error is told."""

    def __init__(self, stop_at: int = -1) -> None:
        self.stop_at, self.seen = stop_at, 0
        self.modules: dict[str, nn.Linear] = {"counter": nn.Linear(1, 1, bias=False)}
        nn.init.ones_(self.modules["counter"].weight)
        self.modules["counter"].register_buffer("steps", torch.zeros(1))

    def batch(self, step: int, generators: StepGenerators) -> dict[str, Tensor]:
        return {}

    def loss(self, batch: dict[str, Tensor], step: int, generators: StepGenerators) -> dict[str, Tensor]:
        if step == self.stop_at:
            raise KeyboardInterrupt
        self.seen += 1
        module = self.modules["counter"]
        module.get_buffer("steps").add_(1)
        return {"loss": module(torch.ones(1)).sum()}

    def validate(self, step: int) -> dict[str, float]:
        return {"error": ERRORS[step // 4 - 1], "step": float(step)}


def train(folder: Path, checks: int | None, stop_at: int = -1, steps: int = 32) -> tuple[Counter, TrainingState]:
    stage = Counter(stop_at)
    patience = None if checks is None else Patience(checks, "error")
    state, _ = fit(Part("toy", stage, toy_config(steps), patience=patience), folder, seed=0)
    return stage, state


@pytest.mark.parametrize(
    ("checks", "ended", "best"),
    [(1, 12, 8), (2, 24, 16), (3, 28, 16), (4, 32, 32), (None, 32, 32)],
)
def test_it_stops_after_so_many_checks_without_a_fall_and_keeps_the_best(
    tmp_path: Path, checks: int | None, ended: int, best: int
) -> None:
    stage, state = train(tmp_path, checks)
    assert stage.seen == state.step == ended
    assert state.metrics["step"] == best
    assert stage.modules["counter"].get_buffer("steps").item() == best


def test_all_steps_done_the_best_is_kept_too(tmp_path: Path) -> None:
    stage, state = train(tmp_path, 4, steps=28)
    assert state.step == 28
    assert state.metrics == {"error": 2.0, "step": 16.0}
    assert stage.modules["counter"].get_buffer("steps").item() == 16


@pytest.mark.integration
@pytest.mark.parametrize("killed", [5, 13, 17, 22, 26])
def test_killed_it_ends_where_it_would_have(tmp_path: Path, killed: int) -> None:
    whole, state = train(tmp_path / "whole", 3)
    with pytest.raises(KeyboardInterrupt):
        train(tmp_path / "parts", 3, stop_at=killed)
    again, resumed = train(tmp_path / "parts", 3)
    assert (resumed.step, resumed.metrics, resumed.stale) == (state.step, state.metrics, state.stale)
    for name, value in whole.modules["counter"].state_dict().items():
        assert torch.equal(value, again.modules["counter"].state_dict()[name])


def test_a_training_that_ended_early_is_not_carried_on(tmp_path: Path) -> None:
    _, first = train(tmp_path, 2)
    stage, second = train(tmp_path, 2)
    assert stage.seen == 0
    assert second == first
    assert stage.modules["counter"].get_buffer("steps").item() == 16


@pytest.mark.parametrize("good", [0, 2])
def test_a_watched_number_that_is_none_ends_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, good: int
) -> None:
    errors = [*ERRORS[:good], float("nan"), *ERRORS[good + 1 :]]
    monkeypatch.setattr(Counter, "validate", lambda _, step: {"step": step, "error": errors[step // 4 - 1]})
    with pytest.raises(TrainingError, match=rf"toy: validation is error not finite at step {4 * good + 4}, expected"):
        train(tmp_path, 2)


def test_another_interval_of_validations_is_another_training(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        train(tmp_path, 2, stop_at=9)
    part = Part("toy", Counter(), toy_config(32, validate_every=8), patience=Patience(2, "error"))
    with pytest.raises(CheckpointError, match="validate_every: got 8, expected 4"):
        fit(part, tmp_path, seed=0)
