"""The lock-step loop, on a task without a simulator."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from playslot_rl import keys
from playslot_rl.acting.actor import ExpertActor, RandomActor
from playslot_rl.acting.episodes import LOCKSTEP, Actions, Moment, Task, TaskPool, run_episodes
from playslot_rl.config import EnvConfig, RenderConfig
from playslot_rl.evaluation.success import summary


class Counter:
    """Solved at the step that its seed's last digit says (0: never; 9: from the start)."""

    def __init__(self) -> None:
        self.draw_steps = True
        self.seed, self.steps, self.log = -1, 0, list[tuple[int, Actions]]()

    def reset(self, *, seed: int | None = None) -> tuple[dict[str, Any], dict[str, Any]]:
        assert seed is not None
        self.seed, self.steps = seed, 0
        return self._observe(), {"success": seed % 10 == 9}

    def step(self, action: Actions) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        self.steps += 1
        self.log.append((self.seed, action))
        return self._observe(), 1.0, False, False, {"success": self.steps == self.seed % 10}

    def _observe(self) -> dict[str, Any]:
        return {"pixels": np.full((2, 2, 3), 10 * (self.seed % 10) + self.steps, np.uint8)}

    def expert_action(self) -> Actions:
        return np.full(4, self.steps / 10, np.float32)

    def close(self) -> None:
        self.steps = -1


class CounterPool(TaskPool):
    def __init__(self, max_steps: int = 6) -> None:
        super().__init__(replace(EnvConfig(), max_steps=max_steps), RenderConfig())
        self.made: list[Counter] = []

    def take(self, count: int) -> list[Task]:
        while len(self.made) < count:
            self.made.append(Counter())
        return list(self.made[:count])


def test_an_episode_that_is_drawn_anew_keeps_its_task(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Counter, "reset", lambda self, seed: (self._observe(), {"success": seed < 30}))
    pool = CounterPool()
    pool.env = replace(pool.env, name="ogbench", task="cube-single")
    assert [e.seed for e in run_episodes(pool, ExpertActor(), [19, 21, 40])] == [34, 31, 40]


def test_each_seed_is_run_once_in_order_and_counts_its_own_steps() -> None:
    seeds = [3, 0, 1, 8, 6, 12, 5]  # more than one chunk
    episodes = run_episodes(CounterPool(), ExpertActor(), seeds)
    assert [e.seed for e in episodes] == seeds
    assert [e.steps for e in episodes] == [3, None, 1, None, 6, 2, 5]
    result = summary(episodes)
    assert result["success_rate"] == pytest.approx(5 / 7)
    assert result["mean_steps_to_success"] == pytest.approx(17 / 5)


def test_an_episode_that_starts_solved_is_redrawn_and_counted() -> None:
    episodes = run_episodes(CounterPool(), ExpertActor(), [18, 19, 20, 21])
    assert [(e.seed, e.redrawn) for e in episodes] == [(18, 0), (23, 1), (20, 0), (21, 0)]
    with pytest.raises(RuntimeError, match="start solved"):
        run_episodes(CounterPool(), ExpertActor(), [9] * 10)


def test_solved_episodes_leave_the_batch_and_the_others_keep_their_place() -> None:
    moments: list[Moment] = []
    run_episodes(CounterPool(), ExpertActor(), [3, 1, 2], moments.append)
    assert [m.episodes for m in moments] == [[0, 1, 2], [0, 2], [0]]
    assert moments[1].frames[:, 0, 0, 0].tolist() == [31, 21]
    assert moments[1].rewards.tolist() == [1.0, 1.0]
    assert moments[1].seen is not None
    assert moments[1].seen[keys.ACTION][:, 0].tolist() == pytest.approx([0.1, 0.1])


def test_whole_episodes_run_on_past_success_where_frames_are_wanted() -> None:
    shown: list[tuple[int, int]] = []
    pool = CounterPool()
    episodes = run_episodes(
        pool,
        ExpertActor(),
        [1] * (LOCKSTEP + 1),
        lambda now: shown.extend((i, now.step) for i in now.episodes),
        stop=False,
    )
    assert all(e.steps == 1 for e in episodes)
    assert sorted(shown) == [(i, t) for i in range(LOCKSTEP + 1) for t in range(7)]


def test_random_actions_depend_on_the_episode_seed_alone() -> None:
    def actions(seeds: list[int], wanted: int) -> list[Any]:
        pool = CounterPool()
        run_episodes(pool, RandomActor(6, 4), seeds)
        return [a.tolist() for task in pool.made for seed, a in task.log if seed == wanted]

    alone = actions([10], 10)
    assert alone == actions([1, 3, 10], 10)
    assert len(alone) == 6
    assert np.abs(alone).max() <= 1
    assert alone != actions([20], 20)


def test_the_last_frame_is_shown_to_the_actor_only_where_it_is_wanted() -> None:
    for see_last in (False, True):
        moments: list[Moment] = []
        run_episodes(CounterPool(2), ExpertActor(), [0], moments.append, see_last=see_last)
        assert [m.step for m in moments] == [0, 1, 2]
        assert [m.seen is not None for m in moments] == [True, True, see_last]
        assert [float(m.rewards[0]) for m in moments] == [0.0, 1.0, 1.0]


def test_frames_that_nobody_looks_at_are_not_drawn() -> None:
    for look_on, draw, drawn in ((None, True, False), (lambda _: None, True, True), (lambda _: None, False, False)):
        pool = CounterPool(2)
        run_episodes(pool, ExpertActor(), [0], look_on, draw=draw)
        assert pool.made[0].draw_steps is drawn
