"""Demonstrations that begin after a disturbed lead-in: clean actions, other first states, and the same collections."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from playslot_rl.collectors.episodes import record
from playslot_rl.collectors.spec import CollectionSpec
from playslot_rl.config import ExperimentConfig
from playslot_rl.config.compose import compose
from playslot_rl.envs import make_env
from playslot_rl.errors import ConfigError

WITH_EXPERT = ("button_press", "block_push", "block_push_easy", "block_reach", "block_pick")


def task(name: str) -> Any:
    config = compose([f"env={name}"])
    env: Any = make_env(config.env, config.render).unwrapped
    env.draw_steps = env.draw_resets = False
    return env


@pytest.mark.parametrize("name", WITH_EXPERT)
def test_a_lead_in_moves_the_first_state_by_the_seed_alone_and_never_to_a_solved_one(name: str) -> None:
    env, options = task(name), {"lead_in": 6, "lead_noise": 0.5}
    plain = [env.reset(seed=seed)[0]["state"] for seed in range(4)]
    led = [env.reset(seed=seed, options=options) for seed in range(4)]
    again = [env.reset(seed=seed, options=options)[0]["state"] for seed in range(4)]
    assert not any(info["success"] for _, info in led)
    assert any(np.abs(state["state"] - start).max() > 0.01 for (state, _), start in zip(led, plain, strict=True))
    for (state, _), other in zip(led, again, strict=True):
        np.testing.assert_array_equal(state["state"], other)
    np.testing.assert_array_equal(env.reset(seed=0)[0]["state"], plain[0])  # and it leaves nothing behind
    env.close()


def test_what_is_recorded_after_a_lead_in_is_the_experts_own() -> None:
    config = compose(["env=block_push_easy", "collect.lead_in=6"])
    spec = CollectionSpec.make(config, "expert", 2, 8, 0)
    env = task("block_push_easy")
    for episode in record(spec, [0, 1]):
        env.reset(seed=episode.seed, options={"lead_in": 6, "lead_noise": spec.lead_noise})
        for action in episode.actions:
            np.testing.assert_array_equal(action, env.expert_action())
            env.step(action)
    env.close()


def test_only_the_experts_episodes_have_a_lead_in() -> None:
    config = compose(["collect.lead_in=6"])
    assert CollectionSpec.make(config, "random", 3, 5, 0).lead_in == 0
    expert = CollectionSpec.make(config, "expert", 3, 5, 0)
    assert (expert.lead_in, expert.lead_noise) == (6, 0.5)


def test_a_collection_from_before_is_the_same_one_and_one_with_a_lead_in_is_another() -> None:
    spec = CollectionSpec.make(ExperimentConfig(), "expert", 3, 5, 0)
    stored = spec.to_dict()
    for key in ("lead_in", "lead_noise"):
        del stored[key]
    assert spec.difference(stored) == ""
    other = CollectionSpec.make(compose(["collect.lead_in=6"]), "expert", 3, 5, 0)
    assert other.difference(stored).startswith("lead_in")


def test_fewer_than_no_steps_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"collect\.lead_in: got -1"):
        compose(["collect.lead_in=-1"])
