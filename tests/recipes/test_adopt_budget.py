"""`adopt` keeps to its minutes: a clock that only steps move, steps that turn out slower or faster than measured."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
from commands import smoke
from test_adopt import write_set

from playslot_rl.datasets import adoption
from playslot_rl.datasets.adoption import FEWEST, Budget, Decisions
from playslot_rl.recipes import adopt, train_dynamics
from playslot_rl.training import fit
from playslot_rl.training.stage_dynamics import DynamicsStage
from playslot_rl.training.stage_slots import SlotsStage

pytestmark = pytest.mark.integration


class Clock:
    """Seconds that pass where they are told to."""

    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    for module in (adopt, adoption, fit):
        monkeypatch.setattr(module, "time", made)
    return made


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_set(tmp_path_factory.mktemp("small") / "set", (14, 14, 14, 14, 14), speed=2)


def slowed(monkeypatch: pytest.MonkeyPatch, clock: Clock, stage: type, seconds: Callable[[int], float]) -> list[int]:
    """Let the steps of a stage take `seconds(n)`, the n-th of all of its trainings; how many there were, in a list."""
    batch, count = stage.batch, [0]  # type: ignore[attr-defined]

    def slow(self: Any, step: int, generators: Any) -> Mapping[str, Any]:
        clock.now += seconds(count[0])
        count[0] += 1
        result: Mapping[str, Any] = batch(self, step, generators)
        return result

    monkeypatch.setattr(stage, "batch", slow)
    return count


def choices(run: Path) -> dict[str, int]:
    stored = json.loads((run / "adopt.json").read_text())["choices"]
    return {name: choice["value"] for name, choice in stored.items()}


def finished(run: Path, stage: str) -> dict[str, Any]:
    meta: dict[str, Any] = json.loads((run / stage / "checkpoint" / "meta.json").read_text())
    return meta


ARGUMENTS = ("adopt.slots=[2]", "adopt.prototypes=4", "adopt.patience=100")


@pytest.mark.parametrize(
    ("slots", "dynamics"),
    [
        (lambda n: 1.0 if n < 30 else 2.0, lambda n: 1.0),  # other jobs begin while SAVi trains
        pytest.param(lambda n: 1.0, lambda n: 1.0, marks=pytest.mark.slow),
        pytest.param(lambda n: 1.0, lambda n: 0.5 if n < 10 else 1.5, marks=pytest.mark.slow),
    ],
)
def test_all_of_it_takes_the_minutes(
    slots: Callable[[int], float],
    dynamics: Callable[[int], float],
    small: Path,
    tmp_path: Path,
    clock: Clock,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    slowed(monkeypatch, clock, SlotsStage, slots)
    slowed(monkeypatch, clock, DynamicsStage, dynamics)
    began, run = clock.now, tmp_path / "run"
    done = smoke("adopt", f"data.root={small}", f"out={run}", "minutes=3", *ARGUMENTS)
    assert 95 < clock.now - began < 183  # less what a report card would take
    for stage in ("slots", "dynamics"):
        assert finished(run, stage)["steps"] > 20
    planned = choices(run)["steps of SAVi"]
    assert finished(run, "slots").get("clocked", False) == (finished(run, "slots")["steps"] != planned)
    assert "minutes=3 are too few" not in done.out


@pytest.mark.slow
def test_a_killed_one_goes_on_with_its_plan_and_the_time_that_is_left(
    small: Path, tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, began = tmp_path / "run", clock.now
    slowed(monkeypatch, clock, SlotsStage, lambda n: 1.0)
    count = slowed(monkeypatch, clock, DynamicsStage, lambda n: 1.0)
    with monkeypatch.context() as patch:
        patch.setattr(adopt.train_dynamics, "main", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        from commands import ONE_CORE, playslot

        assert playslot("adopt", "preset=smoke", f"data.root={small}", f"out={run}", "minutes=3", *ARGUMENTS,
                        *ONE_CORE).code == 130  # fmt: skip
    assert count == [0]
    worked, before = clock.now - began, choices(run)
    clock.now += 100_000  # nobody works
    again = clock.now
    assert train_dynamics.main is adopt.train_dynamics.main
    smoke("adopt", f"data.root={small}", f"out={run}", "minutes=3", *ARGUMENTS)
    assert {name: choices(run)[name] for name in before} == before
    assert 95 < worked + clock.now - again < 183
    third = clock.now
    smoke("adopt", f"data.root={small}", f"out={run}", "minutes=3", *ARGUMENTS)
    assert clock.now == third, "finished is finished"


@pytest.mark.slow
def test_minutes_that_are_too_few_are_said_to_be_at_the_start(
    small: Path, tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    slowed(monkeypatch, clock, SlotsStage, lambda n: 1.0)
    slowed(monkeypatch, clock, DynamicsStage, lambda n: 1.0)
    done = smoke("adopt", f"data.root={small}", f"out={tmp_path / 'run'}", "minutes=0.5", *ARGUMENTS)
    (note,) = [line for line in done.out.splitlines() if "too few" in line]
    assert note.startswith(
        "note: minutes=0.5 are too few for the shortest trainings on this machine: it will take about "
    )
    assert done.out.index(note) < done.out.index("steps of SAVi")


def test_a_run_that_an_earlier_version_began_keeps_its_steps(tmp_path: Path, clock: Clock) -> None:
    decide = Decisions(tmp_path, {}, clock.now)
    budget = Budget(decide, 60.0, frames=100, episodes=10, actions=False)
    (tmp_path / "slots").mkdir()
    assert budget.steps("SAVi", tmp_path, "slots", 10.0, 100, before=36.0) == 360
    assert budget.steps("the dynamics", tmp_path, "dynamics", 10.0, 100, before=20.0) == 100
    assert budget.steps("the dynamics", tmp_path, "dynamics", 5.0, 100, before=20.0) == 100, "decided once"


def test_the_report_card_has_the_episodes_that_there_is_time_for(tmp_path: Path, clock: Clock) -> None:
    decide = Decisions(tmp_path, {}, clock.now)
    budget = Budget(decide, 100.0, frames=20_000, episodes=200, actions=True)
    assert budget.card_episodes(a_frame=1e-4).value == 200
    clock.now += 90
    some = budget.card_episodes(a_frame=1e-3).value
    assert FEWEST < some < 200
    assert budget.card(some, 1e-3) <= 10
    clock.now += 90
    assert budget.card_episodes(a_frame=1e-3).value == FEWEST
