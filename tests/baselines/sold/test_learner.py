"""SOLD's update: which loss moves what, where rollouts start, and that it learns."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from playslot_rl import keys
from playslot_rl.baselines.sold.imagination import imagine
from playslot_rl.baselines.sold.learner import SOLDLearner
from playslot_rl.training.seeding import StepGenerators

Make = Callable[..., SOLDLearner]
NETWORKS = ("dynamics", "reward", "actor", "critic")


def _weights(learner: SOLDLearner) -> dict[str, torch.Tensor]:
    modules = {**learner.modules, "savi": learner.savi}
    return {f"{n}.{k}": v.clone() for n, module in modules.items() for k, v in module.state_dict().items()}


def _moved(learner: SOLDLearner, before: dict[str, torch.Tensor]) -> set[str]:
    return {key.split(".")[0] for key, value in _weights(learner).items() if not torch.equal(value, before[key])}


@pytest.mark.parametrize("name", NETWORKS)
def test_every_loss_moves_its_own_network_only(
    make_learner: Make, batch: TensorDict, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The update with the steps of the other networks left out moves one network; with all of them, all four."""
    learner = make_learner()
    before, step = _weights(learner), learner._step
    monkeypatch.setattr(
        learner, "_step", lambda n, loss, keep=False: step(n, loss, keep) if n == name else torch.zeros(())
    )
    learner.update(batch, StepGenerators(0, 0))
    followers = {"returns"} | ({"slow_critic"} if name == "critic" else set())
    assert _moved(learner, before) == {name} | followers


def test_savi_is_untouched_even_by_the_image_loss(make_learner: Make, batch: TensorDict) -> None:
    learner = make_learner(image_weight=1.0)
    before = _weights(learner)
    metrics = learner.update(batch, StepGenerators(0, 0))
    assert metrics["image_mse"] > 0
    assert _moved(learner, before) == {*NETWORKS, "slow_critic", "returns"}
    assert all(parameter.grad is None for parameter in learner.savi.parameters())


def test_the_image_loss_reaches_the_dynamics_through_the_frozen_decoder(make_learner: Make, batch: TensorDict) -> None:
    learner = make_learner(image_weight=1.0, slot_weight=0.0, decoded_frames=1)
    assert learner.stored == (keys.SLOTS, keys.PIXELS)
    assert learner.update(batch, StepGenerators(0, 0))["dynamics_grad_norm"] > 0


@pytest.mark.parametrize("gradient", ["dynamics", "reinforce"])
def test_the_actor_gets_a_gradient_by_both_estimators(make_learner: Make, batch: TensorDict, gradient: str) -> None:
    learner = make_learner(actor_gradient=gradient, entropy=0.0)
    assert learner.update(batch, StepGenerators(0, 0))["actor_grad_norm"] > 0


def test_without_reward_value_or_entropy_the_dynamics_gradient_is_zero(make_learner: Make, batch: TensorDict) -> None:
    learner = make_learner(spread=False, entropy=0.0, model_lr=0.0)
    assert learner.update(batch, StepGenerators(0, 0))["actor_grad_norm"] < 1e-6


def test_the_slow_critic_follows_at_its_rate(make_learner: Make, batch: TensorDict) -> None:
    learner = make_learner(critic_decay=0.75)
    old = learner.slow_critic.out.weight.clone()
    learner.update(batch, StepGenerators(0, 0))
    expected = 0.75 * old + 0.25 * learner.networks.critic.out.weight
    torch.testing.assert_close(learner.slow_critic.out.weight, expected)


def test_the_first_updates_may_leave_actor_and_critic_alone(make_learner: Make, batch: TensorDict) -> None:
    learner = make_learner(world_model_updates=2)
    before = _weights(learner)
    learner.update(batch, StepGenerators(0, 1))
    assert _moved(learner, before) == {"dynamics", "reward"}
    learner.update(batch, StepGenerators(0, 2))
    assert {"actor", "critic"} <= _moved(learner, before)


def test_equal_seeds_give_equal_updates_bit_for_bit(make_learner: Make, batch: TensorDict) -> None:
    first, second = make_learner(), make_learner()
    for step in range(2):
        first.update(batch, StepGenerators(3, step))
        second.update(batch, StepGenerators(3, step))
    assert all(torch.equal(value, _weights(second)[key]) for key, value in _weights(first).items())


def test_rollouts_start_within_one_episode_with_the_actions_taken_there(make_learner: Make, batch: TensorDict) -> None:
    learner = make_learner(starts=40)
    flat = batch[keys.SLOTS].flatten(2)  # every frame's content is its own name
    episode = batch[keys.IS_FIRST].squeeze(-1).long().cumsum(dim=1)
    lengths, ends = set(), set()
    for step in range(12):
        slots, actions = learner._starts(batch, StepGenerators(0, step))
        lengths.add(slots.shape[1])
        assert actions.shape[1] == slots.shape[1] - 1
        for window, taken in zip(slots.flatten(2), actions, strict=True):
            places = [tuple((flat == frame).all(dim=-1).nonzero()[0].tolist()) for frame in window]
            row, start = places[0]
            assert places == [(row, start + i) for i in range(len(places))]
            assert len({int(episode[place]) for place in places}) == 1
            assert torch.equal(taken, batch[keys.ACTION][row, start + 1 : start + len(places)])
            ends.add(places[-1])
    assert lengths == {1, 2, 3}
    assert ends == {(row, t) for row in range(3) for t in range(6)}


def test_imagined_steps_follow_from_the_dynamics_and_the_actors_history(make_learner: Make, batch: TensorDict) -> None:
    networks = make_learner().networks
    context, taken = batch[keys.SLOTS][:, :3], batch[keys.ACTION][:, 1:3]
    out = imagine(networks.dynamics, networks.actor, context, taken, 3, torch.Generator().manual_seed(0))
    torch.testing.assert_close(out.slots[:, :3], context)
    whole = networks.dynamics(out.slots[:, :-1], torch.cat((taken, out.actions), dim=1))[0]
    torch.testing.assert_close(out.slots[:, 3:], whole[:, 2:])
    location, std, _ = networks.actor(out.slots)
    from playslot_rl.baselines.sold.heads import action_distribution

    expected = action_distribution(location[:, 2:-1], std[:, 2:-1]).log_prob(out.actions)
    torch.testing.assert_close(out.log_probs, expected, atol=1e-4, rtol=1e-4)


def test_an_action_that_moves_slots_towards_reward_is_found(make_learner: Make) -> None:
    """A world of one number: the action adds to it and the reward is that number. The policy learns to push it up."""
    learner = make_learner(
        spread=False, gamma=0.9, model_lr=5e-3, actor_lr=5e-3, critic_lr=5e-3, batch_size=16, starts=24, horizon=2
    )
    metrics: dict[str, Any] = {}
    for step in range(100):
        metrics = dict(learner.update(_line(step), StepGenerators(0, step)))
    location, _, _ = learner.networks.actor(_line(999)[keys.SLOTS])
    assert metrics["slot_mse"] < 0.02
    assert location[:, :, 0].mean() > 0.5


def _line(seed: int) -> TensorDict:
    """Sequences in which slot 0 of feature 0 is x, x' = x + a_0 / 2, reward x'."""
    generator = torch.Generator().manual_seed(seed)
    actions = torch.rand(16, 6, 4, generator=generator) * 2 - 1
    start = torch.rand(16, 1, generator=generator) - 0.5
    x = start + torch.cat((torch.zeros(16, 1), actions[:, 1:, 0] / 2), dim=1).cumsum(dim=1)
    slots = torch.zeros(16, 6, 4, 32)
    slots[:, :, 0, 0] = x
    flags = torch.zeros(16, 6, 1, dtype=torch.bool)
    values = {keys.SLOTS: slots, keys.ACTION: actions, keys.REWARD: x.unsqueeze(-1), keys.IS_FIRST: flags}
    return TensorDict(values, [16, 6])
