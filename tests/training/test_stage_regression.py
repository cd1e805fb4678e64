"""Regression as a stage: the rows it draws, and that the oracle beside the policy is the oracle alone."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import nn

from playslot_rl import keys
from playslot_rl.config import BehaviourStageConfig, OptimConfig, StageConfig
from playslot_rl.data.demonstrations import Demonstrations
from playslot_rl.losses.behaviour import BehaviourLoss
from playslot_rl.modules.policy import LatentPolicy
from playslot_rl.seeding import StepGenerators
from playslot_rl.testing import tiny_config
from playslot_rl.training.fit import Part, fit
from playslot_rl.training.stage_behaviour import CloneStage, oracle_stage
from playslot_rl.training.stage_regression import RegressionStage, TensorInputs, unexplained


def _stage(network: nn.Module, x: torch.Tensor, y: torch.Tensor) -> RegressionStage:
    criterion = BehaviourLoss(network)
    criterion.set_keys(action=keys.ACTION)
    return RegressionStage("network", criterion, TensorInputs(x), y, 16)


def test_a_linear_map_is_found(tmp_path: Path) -> None:
    torch.manual_seed(0)
    x = torch.randn(200, 3)
    y = x @ torch.randn(3, 2)
    network = nn.Linear(3, 2)
    config = StageConfig(steps=200, batch_size=16, optim=OptimConfig(lr=3e-2))
    result = fit(Part("toy", _stage(network, x, y), config), tmp_path, seed=0)
    assert result.metrics["unexplained"] < 0.01


def test_batches_are_a_function_of_seed_and_step() -> None:
    x, y, network = torch.randn(50, 3), torch.randn(50, 2), nn.Linear(3, 2)
    losses = [
        float(_stage(network, x, y).loss(0, StepGenerators(*where))["loss"]) for where in ((0, 1), (0, 1), (0, 2))
    ]
    assert losses[0] == losses[1] != losses[2]


def test_unequal_numbers_are_refused() -> None:
    with pytest.raises(ValueError, match="got 4 targets, expected one for each of 5 inputs"):
        _stage(nn.Linear(3, 2), torch.zeros(5, 3), torch.zeros(4, 2))


def test_nothing_explained_is_one_and_everything_zero() -> None:
    target = torch.randn(30, 2)
    assert unexplained(target, target) == 0
    assert unexplained(target.mean(0).expand(30, 2), target) == pytest.approx(1.0)


def test_the_oracle_beside_the_policy_is_the_oracle_alone() -> None:
    torch.manual_seed(0)
    sizes, config = tiny_config().model.policy, BehaviourStageConfig(batch_size=8, slot_noise=0.1, imagined=True)
    demos = Demonstrations(
        slots=torch.randn(30, 4, 32), imagined=torch.randn(30, 4, 32), latents=torch.randn(30, 8),
        actions=torch.rand(30, 4), episode=torch.zeros(30, dtype=torch.long), lengths=torch.tensor([30]),
    )  # fmt: skip
    beside, alone = LatentPolicy(sizes, 32, 4), LatentPolicy(sizes, 32, 4)
    alone.load_state_dict(beside.state_dict())
    assert demos.actions is not None
    generators = StepGenerators(3, 5)
    CloneStage(LatentPolicy(sizes, 32, 8), beside, demos, config).loss(5, generators)["loss"].backward()
    oracle_stage(alone, demos.slots, demos.actions, config).loss(5, generators)["loss"].backward()
    for one, two in zip(beside.parameters(), alone.parameters(), strict=True):
        assert one.grad is not None
        assert two.grad is not None
        torch.testing.assert_close(one.grad, two.grad)
