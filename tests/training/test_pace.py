"""Trainings by the clock: steps that turn out to be slower are fewer, the schedule ends where the training does, and a
killed one goes on in the time that is left. The clock is a fake one.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from playslot_rl.config import OptimConfig, StageConfig
from playslot_rl.seeds.draws import StepGenerators
from playslot_rl.storage.resume import TrainingState
from playslot_rl.training import fit as fit_module
from playslot_rl.training.fit import Part, fit
from playslot_rl.training.pace import Pace

PLANNED = 100


class Clock:
    """Seconds that only pass where a stage says so."""

    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        return self.now


class Slow:
    """A stage whose steps take as long as it is told."""

    def __init__(self, clock: Clock, seconds: Mapping[int, float], validation: float = 0.0, dies: int = -1) -> None:
        self.clock, self.seconds, self.validation, self.dies = clock, seconds, validation, dies
        self.layer = nn.Linear(2, 1)

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        return {"layer": self.layer}

    def batch(self, step: int, generators: StepGenerators) -> Mapping[str, Tensor]:
        return {}

    def loss(self, batch: Mapping[str, Tensor], step: int, generators: StepGenerators) -> Mapping[str, Tensor]:
        if step == self.dies:
            raise KeyboardInterrupt
        self.clock.now += next(
            seconds for first, seconds in sorted(self.seconds.items(), reverse=True) if step >= first
        )
        return {"loss": self.layer(torch.ones(1, 2)).square().sum()}

    def validate(self, step: int) -> Mapping[str, float]:
        self.clock.now += self.validation
        return {"mse": 1.0}


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(fit_module, "time", made)
    return made


CONFIG = StageConfig(
    steps=PLANNED, batch_size=1, checkpoint_every=10, validate_every=10, log_every=1, optim=OptimConfig(lr=1.0)
)


def trained(stage: Slow, folder: Path, pace: Pace | None) -> TrainingState:
    return fit(Part("slow", stage, CONFIG, pace=pace), folder, seed=0)[0]


def rates(folder: Path) -> list[float]:
    rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [row["lr"] for row in rows if row["split"] == "train"]


@pytest.mark.integration
@pytest.mark.parametrize(
    ("seconds", "validation", "fewest", "most"),
    [
        ({0: 1.0}, 0.0, 100, 100),  # as planned
        ({0: 2.0}, 0.0, 48, 50),  # twice as slow from the first step on
        ({0: 1.0, 40: 4.0}, 0.0, 54, 55),  # another job begins
        ({0: 4.0, 10: 1.0}, 0.0, 68, 70),  # another job ends
        ({0: 20.0}, 0.0, 5, 5),
        ({0: 0.5}, 5.0, 92, 100),  # what is between the steps counts
        ({0: 0.25}, 0.0, 380, 400),
        ({0: 4.0, 10: 0.66}, 0.0, 100, 100),  # as planned in the end, by another way
    ],
)
def test_a_training_keeps_to_its_time(
    clock: Clock, tmp_path: Path, seconds: dict[int, float], validation: float, fewest: int, most: int
) -> None:
    began = clock.now
    state = trained(Slow(clock, seconds, validation), tmp_path, Pace(100.0))
    assert fewest <= state.step <= most
    assert clock.now - began <= 100.0 + max(*seconds.values(), validation, 1.0)
    assert state.metrics == {"mse": 1.0}
    learning = rates(tmp_path)
    assert len(learning) == state.step
    assert learning[0] == 1.0
    assert learning[-1] < 0.1, "the schedule ends with the training"
    trained(Slow(clock, {0: 1.0}), tmp_path / "plain", None)
    assert (state.planned != 0) == (learning != rates(tmp_path / "plain")), "only so a card knows"


def test_it_has_a_least_number_of_steps_and_without_a_pace_all(clock: Clock, tmp_path: Path) -> None:
    assert trained(Slow(clock, {0: 50.0}), tmp_path / "least", Pace(100.0, least=20)).step == 20
    assert trained(Slow(clock, {0: 50.0}), tmp_path / "none", None).step == PLANNED


def test_steps_are_not_added_while_they_are_cheaper_than_those_to_come(clock: Clock, tmp_path: Path) -> None:
    stage = Slow(clock, {0: 0.25, 30: 1.0})
    assert trained(stage, tmp_path / "known", Pace(100.0, settled=30)).step == pytest.approx(122, abs=2)


def test_a_killed_training_goes_on_in_the_time_that_is_left(clock: Clock, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        trained(Slow(clock, {0: 2.0}, dies=25), tmp_path, Pace(100.0))
    clock.now += 10_000  # nobody works
    began = clock.now
    state = trained(Slow(clock, {0: 1.0}), tmp_path, Pace(100.0))
    assert clock.now - began == pytest.approx(60, abs=2)  # of 100 seconds 20 steps took 40
    assert state.step == pytest.approx(80, abs=2)
    assert state.planned == state.step
    again = trained(Slow(clock, {0: 1.0}), tmp_path, Pace(100.0))
    assert replace(again, seconds=0) == replace(state, seconds=0), "finished is finished"
