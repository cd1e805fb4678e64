"""Schedules, clipping, and randomness by step."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

from playslot_rl.config import OptimConfig
from playslot_rl.seeds.draws import StepGenerators, global_seed, step_generator
from playslot_rl.training.optimizer import build_adam, clip_gradients, learning_rate, trainable_parameters


def test_warm_up_is_linear_and_cosine_ends_near_zero() -> None:
    config = OptimConfig(lr=2.0, warmup_steps=4)
    rates = [learning_rate(config, step, 104) for step in range(104)]
    assert rates[:4] == [0.5, 1.0, 1.5, 2.0]
    assert rates[4] == 2.0
    assert rates[54] == pytest.approx(1.0)
    assert 0 < rates[-1] < 0.001
    assert rates[4:] == sorted(rates[4:], reverse=True)


def test_the_constant_schedule_stays() -> None:
    config = OptimConfig(lr=2.0, warmup_steps=0, schedule="constant")
    assert {learning_rate(config, step, 10) for step in range(10)} == {2.0}


def test_clipping_returns_the_norm_before_and_bounds_the_norm_after() -> None:
    modules = {"net": nn.Linear(3, 2)}
    parameters = trainable_parameters(modules)
    for parameter in parameters.values():
        parameter.grad = torch.ones_like(parameter)
    assert float(clip_gradients(parameters, 0.0)) == pytest.approx(8**0.5)
    assert float(clip_gradients(parameters, 0.5)) == pytest.approx(8**0.5)
    assert float(clip_gradients(parameters, 0.0)) == pytest.approx(0.5, rel=1e-4)


def test_a_stage_without_trainable_parameters_is_refused() -> None:
    with pytest.raises(ValueError, match="no trainable parameters"):
        build_adam({}, OptimConfig())


def test_draws_depend_on_seed_step_and_stream_only() -> None:
    def draw(seed: int, step: int, stream: str) -> torch.Tensor:
        return torch.rand(4, generator=step_generator(seed, step, stream))

    assert torch.equal(draw(1, 2, "a"), draw(1, 2, "a"))
    for other in [(2, 2, "a"), (1, 3, "a"), (1, 2, "b"), (12, 0, "a")]:
        assert not torch.equal(draw(1, 2, "a"), draw(*other))
    first, again, other = (StepGenerators(1, 2).numpy(stream).random(3) for stream in ("a", "a", "b"))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_global_seed_repeats_and_leaves_the_outer_state_alone() -> None:
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    draws = []
    for _ in range(2):
        with global_seed(1, 7):
            draws.append(torch.rand(2))
    assert torch.equal(draws[0], draws[1])
    assert torch.equal(torch.rand(3), expected)
