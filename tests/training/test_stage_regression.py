"""Regression as a stage: the rows it draws, and that oracle and policy do not change each other."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import nn

from playslot_rl import keys
from playslot_rl.config import BehaviourStageConfig, OptimConfig, Precision, StageConfig
from playslot_rl.data.demonstrations import Demonstrations
from playslot_rl.losses.behaviour import BehaviourLoss
from playslot_rl.modules.action_decoder import ActionDecoder
from playslot_rl.modules.policy import LatentPolicy
from playslot_rl.seeds.draws import StepGenerators
from playslot_rl.testing import tiny_config
from playslot_rl.training.fit import Part, fit
from playslot_rl.training.stage import step_loss
from playslot_rl.training.stage_behaviour import CloneStage, DecoderStage, oracle_stage
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
    state, _ = fit(Part("toy", _stage(network, x, y), config), tmp_path, seed=0)
    assert state.metrics["unexplained"] < 0.01


def test_batches_are_a_function_of_seed_and_step() -> None:
    x, y, network = torch.randn(50, 3), torch.randn(50, 2), nn.Linear(3, 2)
    losses = [
        float(step_loss(_stage(network, x, y), 0, StepGenerators(*where))["loss"]) for where in ((0, 1), (0, 1), (0, 2))
    ]
    assert losses[0] == losses[1] != losses[2]


def test_unequal_numbers_are_refused() -> None:
    with pytest.raises(ValueError, match="got 4 targets, expected one for each of 5 inputs"):
        _stage(nn.Linear(3, 2), torch.zeros(5, 3), torch.zeros(4, 2))


def test_nothing_explained_is_one_and_everything_zero() -> None:
    target = torch.randn(30, 2)
    assert unexplained(target, target) == 0
    assert unexplained(target.mean(0).expand(30, 2), target) == pytest.approx(1.0)


def _demos(seed: int, count: int = 30) -> Demonstrations:
    torch.manual_seed(seed)
    return Demonstrations(
        slots=torch.randn(count, 4, 32), imagined=torch.randn(count, 4, 32), latents=torch.randn(count, 8),
        actions=torch.rand(count, 4), episode=torch.zeros(count, dtype=torch.long), step=torch.arange(count),
        lengths=torch.tensor([count]),
    )  # fmt: skip


def test_what_has_no_target_is_not_measured() -> None:
    x, y, network = torch.randn(9, 3), torch.randn(9, 2), nn.Linear(3, 2)
    given = [torch.where(torch.arange(9)[:, None] < count, y, torch.nan) for count in (5, 0)]
    some, none = (
        RegressionStage("n", _stage(network, x, y).criterion, TensorInputs(x), y, 4, held_out=(TensorInputs(x), part))
        for part in given
    )
    assert some.validate(0)["unexplained_held_out"] == pytest.approx(unexplained(network(x[:5]).detach(), y[:5]))
    assert none.validate(0).keys() == {"unexplained"}


def _policies() -> tuple[LatentPolicy, LatentPolicy]:
    torch.manual_seed(1)
    sizes = tiny_config().model.policy
    return LatentPolicy(sizes, 32, 8), LatentPolicy(sizes, 32, 4)


def test_held_out_demonstrations_measure_and_are_not_trained_on() -> None:
    demos, other = _demos(0), _demos(5, 20)
    config = BehaviourStageConfig(batch_size=8, labelled_demos=1, decoder_inputs="both")
    policy, oracle = _policies()
    alone = CloneStage(policy, oracle, demos, config)
    beside = CloneStage(policy, oracle, demos, config, other)
    generators = StepGenerators(3, 5)
    with torch.no_grad():
        assert step_loss(alone, 5, generators)["loss"] == step_loss(beside, 5, generators)["loss"]
        plain, both = alone.validate(1), beside.validate(1)
    assert {key: both[key] for key in plain} == plain
    assert both.keys() - plain.keys() == {f"{key}_held_out" for key in plain}
    assert both["unexplained_parsed_held_out"] == unexplained(policy(other.slots), other.latents)
    assert other.actions is not None
    assert both["oracle_unexplained_held_out"] == unexplained(oracle(other.slots), other.actions)
    decoder = ActionDecoder(tiny_config().model.action_decoder, 8, 4).eval()
    decode = DecoderStage(decoder, policy, demos, config, other)
    seen = torch.cat([other.latents, policy(other.slots), policy(other.imagined)])
    expected = unexplained(decoder(seen), other.actions.repeat(3, 1))
    assert decode.validate(1)["unexplained_held_out"] == pytest.approx(expected, rel=1e-5)
    assert set(DecoderStage(decoder, policy, demos, config).validate(1)) == {"unexplained"}


def test_bf16_is_trained_under_autocast_and_validated_in_fp32() -> None:
    demos, (policy, oracle) = _demos(0), _policies()
    decoder = ActionDecoder(tiny_config().model.action_decoder, 8, 4).eval()

    def stages(precision: Precision) -> list[CloneStage | DecoderStage]:
        config = BehaviourStageConfig(batch_size=8, labelled_demos=1, precision=precision)
        return [CloneStage(policy, oracle, demos, config), DecoderStage(decoder, policy, demos, config)]

    for full, half, plain in zip(stages("fp32"), stages("bf16"), stages("fp32"), strict=True):
        with torch.no_grad():
            losses = [step_loss(stage, 5, StepGenerators(3, 5)) for stage in (full, half, plain)]
            assert full.validate(1) == half.validate(1)
        for name in losses[0]:
            assert losses[0][name] == losses[2][name] != losses[1][name]
            torch.testing.assert_close(losses[0][name], losses[1][name], rtol=0.05, atol=0.05)


@pytest.mark.parametrize("grad_clip", [0.0, 0.05])
def test_oracle_and_policy_learn_side_by_side_what_each_learns_alone(tmp_path: Path, grad_clip: float) -> None:
    """The policy sees no real action: not even the norm of the oracle's gradients, by which both would be clipped."""
    optim = OptimConfig(lr=1e-2, grad_clip=grad_clip)
    config = BehaviourStageConfig(steps=4, batch_size=8, slot_noise=0.1, imagined=True, optim=optim)
    demos, sizes = _demos(0), tiny_config().model.policy
    assert demos.actions is not None

    def made() -> tuple[LatentPolicy, LatentPolicy]:
        torch.manual_seed(0)
        return LatentPolicy(sizes, 32, 8), LatentPolicy(sizes, 32, 4)

    (policy, oracle), (cloning, _), (_, acting) = made(), made(), made()
    stages = (
        CloneStage(policy, oracle, demos, config),
        CloneStage(cloning, None, demos, config),
        oracle_stage(acting, demos.slots, demos.actions, config),
    )
    for i, stage in enumerate(stages):
        fit(Part("policy", stage, config), tmp_path / str(i), seed=3)
    for one, other in ((policy, cloning), (oracle, acting)):
        torch.testing.assert_close(one.state_dict(), other.state_dict(), rtol=0, atol=0)
