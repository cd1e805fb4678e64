"""Disturbed demonstrations: which steps, how much, and that a collection of before is still the same."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from playslot_rl.collectors.episodes import REST, CollectionPolicy
from playslot_rl.collectors.spec import CollectionSpec
from playslot_rl.config import ExperimentConfig
from playslot_rl.config.compose import compose
from playslot_rl.errors import ConfigError

MOVES = torch.tensor([0.5, -0.25, 0.1, 0.0])


def actions(policy: CollectionPolicy, expert: Tensor, count: int = 2000) -> Tensor:
    """Actions (count, A) of as many steps of one episode."""
    return torch.stack([policy(expert, torch.tensor([7]), torch.tensor([i])) for i in range(count)])


def test_as_many_steps_are_disturbed_as_asked_and_the_others_are_the_experts() -> None:
    drawn = actions(CollectionPolicy("expert", disturbed=0.25, disturbance=0.7), MOVES)
    disturbed = (drawn != MOVES).any(dim=1)
    assert disturbed.float().mean() == pytest.approx(0.25, abs=0.04)  # four standard errors
    assert drawn[disturbed].abs().max() <= 1
    height = drawn[disturbed, 2]
    assert height.median() == pytest.approx(float(MOVES[2]), abs=0.12)  # clipping leaves the median
    assert drawn.median(dim=0).values.equal(MOVES)  # what `loss=l1` clones


def test_an_expert_that_holds_still_is_left_alone() -> None:
    still = torch.full((4,), REST)
    drawn = actions(CollectionPolicy("expert", disturbed=1.0, disturbance=0.7), still, 50)
    assert drawn.equal(still.expand(50, 4))


def test_steps_are_a_function_of_the_seed() -> None:
    policy = CollectionPolicy("expert", noise=0.1, disturbed=0.5, disturbance=0.7)
    assert actions(policy, MOVES, 20).equal(actions(policy, MOVES, 20))


def test_only_the_experts_episodes_are_disturbed() -> None:
    config = compose(["collect.disturbed=0.25"])
    assert CollectionSpec.make(config, "random", 3, 5, 0).disturbed == 0
    expert = CollectionSpec.make(config, "expert", 3, 5, 0)
    assert (expert.disturbed, expert.disturbance) == (0.25, 0.7)


def test_a_collection_from_before_is_the_same_one_and_a_disturbed_one_is_another() -> None:
    spec = CollectionSpec.make(ExperimentConfig(), "expert", 3, 5, 0)
    stored = spec.to_dict()
    for key in ("disturbed", "disturbance"):
        del stored[key]
    assert spec.difference(stored) == ""
    other = CollectionSpec.make(compose(["collect.disturbed=0.25"]), "expert", 3, 5, 0)
    assert other.difference(stored).startswith("disturb")


def test_what_is_no_probability_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"collect\.disturbed: got 1\.5"):
        compose(["collect.disturbed=1.5"])
