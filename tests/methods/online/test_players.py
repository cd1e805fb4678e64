"""Rounds played by workers beside the learner: what they are played with, restarts, dead workers."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from online_toy import STEPS, BrokenPool, HangingPool, ToyLearner, ToyPool, interrupt, same, toy_online, train, weights
from tensordict import TensorDict
from torch import Tensor

from playslot_rl import keys
from playslot_rl.collectors import workers
from playslot_rl.config import CollectorConfig, EnvConfig, RenderConfig
from playslot_rl.errors import PlaySlotError
from playslot_rl.methods.online import loop
from playslot_rl.methods.online.acting import PlayedEpisodes
from playslot_rl.methods.online.players import Players, Round, play_round
from playslot_rl.seeds.draws import StepGenerators
from playslot_rl.storage.tensors import module_tensors

pytestmark = pytest.mark.integration

TASK = EnvConfig(max_steps=STEPS), RenderConfig()
CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def _toy_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop, "TaskPool", ToyPool)


class Beside:
    """`Players` without processes: the same weights and parts, played when they are asked for."""

    def __init__(self, learner: ToyLearner, make_pool: Any, count: int, settings: CollectorConfig) -> None:
        self.learner, self.pool, self.count = learner, make_pool(), count
        self.begun: tuple[dict[str, Tensor], Round] | None = None

    def begin(self, wanted: Round) -> None:
        self.begun = weights(self.learner), wanted

    @property
    def playing(self) -> bool:
        return self.begun is not None

    def finish(self) -> PlayedEpisodes:
        assert self.begun is not None
        (old, wanted), self.begun = self.begun, None
        actor = ToyLearner()
        for key, value in module_tensors(actor.modules).items():
            value.copy_(old[key])
        pool: Any = self.pool
        parts = [play_round(pool, actor, CPU, part, i) for i, part in enumerate(wanted.split(self.count))]
        sums = [value for part in parts for value in part.returns]
        solved = [value for part in parts for value in part.successes]
        return PlayedEpisodes(torch.cat([part.frames for part in parts]), tuple(sums), tuple(solved))

    def close(self) -> None:
        pass


def test_worker_processes_play_what_the_weights_of_the_round_before_play(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, one = train(tmp_path / "real", workers=2)
    with monkeypatch.context() as patch:
        patch.setattr(loop, "Players", Beside)
        told, other = train(tmp_path / "told", workers=2)
    assert same(weights(real), weights(told))
    assert [row["return_mean"] for row in one.state.curve] == [row["return_mean"] for row in other.state.curve]
    here, _ = train(tmp_path / "here")
    assert not same(weights(real), weights(here))  # the newest weights play other episodes


def test_the_weights_are_one_round_old(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    order: list[tuple[str, int]] = []

    class Watched(Beside):
        def begin(self, wanted: Round) -> None:
            order.append(("begin", wanted.number))
            super().begin(wanted)

        def finish(self) -> PlayedEpisodes:
            assert self.begun is not None
            order.append(("finish", self.begun[1].number))
            return super().finish()

    original = ToyLearner.update

    def noted(self: ToyLearner, batch: TensorDict, generators: StepGenerators) -> Mapping[str, Tensor]:
        order.append(("update", generators.step))
        return original(self, batch, generators)

    monkeypatch.setattr(loop, "Players", Watched)
    monkeypatch.setattr(ToyLearner, "update", noted)
    train(tmp_path, workers=1, steps=32, prefill=16, update_ratio=0.125, checkpoint_every=1000)
    assert order == [
        ("begin", 0), ("finish", 0), ("begin", 1), ("finish", 1), ("begin", 2), ("update", 0),
        ("finish", 2), ("begin", 3), ("update", 1), ("finish", 3), ("update", 2),
    ]  # fmt: skip


@pytest.mark.parametrize("at", [9, 22])
def test_a_run_that_was_interrupted_ends_with_the_weights_of_one_that_was_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at: int
) -> None:
    monkeypatch.setattr(loop, "Players", Beside)
    whole, _ = train(tmp_path / "whole", workers=2)
    interrupt(monkeypatch, at, tmp_path / "broken", "the same command carries on from", workers=2)
    broken, result = train(tmp_path / "broken", workers=2)
    assert result.resumed_from > 0
    assert same(weights(whole), weights(broken))


def test_a_run_from_before_there_were_workers_carries_on_without_them(tmp_path: Path) -> None:
    whole, _ = train(tmp_path / "whole")
    train(tmp_path / "old", steps=32)
    for path in tmp_path.glob("old/toy/checkpoints/*/state.json"):
        state = json.loads(path.read_text())
        state["identity"]["toy"] |= {"steps": 64}
        del state["identity"]["toy"]["workers"], state["ahead"]
        path.write_text(json.dumps(state))
    carried, result = train(tmp_path / "old")
    assert result.resumed_from == 32
    assert same(weights(whole), weights(carried))


def test_workers_divide_the_episodes_of_a_round() -> None:
    with pytest.raises(ValueError, match=r"workers: got 3, expected 0 or a divisor of envs \(2\)"):
        toy_online(workers=3)


def team(count: int, **settings: Any) -> Players:
    learner: Any = ToyLearner()
    return Players(learner, partial(ToyPool, *TASK), count, CollectorConfig(**settings))


def test_a_worker_that_dies_is_replaced_and_its_part_played_again() -> None:
    wanted = Round(3, 7, (5, 6), random=False)
    crew = team(2)
    try:
        crew.begin(wanted)
        before = crew.finish()
        local: Any = crew.workers._places[0].worker
        os.kill(local.process.pid, signal.SIGKILL)
        crew.begin(wanted)
        after = crew.finish()
        assert crew.workers.replaced == 1
    finally:
        crew.close()
    assert torch.equal(before.frames[keys.ACTION], after.frames[keys.ACTION])
    assert before.returns == after.returns
    assert before.frames.batch_size == (2, STEPS + 1)


def test_workers_that_hang_end_the_training_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "START_S", 1.0)
    learner: Any = ToyLearner()
    crew = Players(learner, partial(HangingPool, *TASK), 1, CollectorConfig(timeout_s=0.5, restarts=0))
    try:
        crew.begin(Round(3, 0, (5,), random=True))
        with pytest.raises(PlaySlotError, match=r"gave no answer for 0\.5 s.*collector\.restarts=0.*carries on"):
            crew.finish()
    finally:
        crew.close()


def test_an_error_of_a_worker_is_told_as_it_is() -> None:
    learner: Any = ToyLearner()
    crew = Players(learner, partial(BrokenPool, *TASK), 1, CollectorConfig())
    try:
        crew.begin(Round(3, 0, (5,), random=True))
        with pytest.raises(PlaySlotError, match="render: got none"):
            crew.finish()
    finally:
        crew.close()


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_two_workers_on_ray_play_what_two_processes_play(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))  # where the actors find the toy
    wanted, found = Round(3, 7, (5, 6), random=False), []
    for backend in ("local", "ray"):
        crew = team(2, backend=backend)
        try:
            crew.begin(wanted)
            found.append(crew.finish())
        finally:
            crew.close()
    assert torch.equal(found[0].frames[keys.ACTION], found[1].frames[keys.ACTION])
    assert found[0].returns == found[1].returns
    learner: Any = ToyLearner()
    crew = Players(learner, partial(BrokenPool, *TASK), 1, CollectorConfig(backend="ray"))
    try:
        crew.begin(wanted)
        with pytest.raises(PlaySlotError, match=r"^render: got none"):
            crew.finish()
    finally:
        crew.close()
