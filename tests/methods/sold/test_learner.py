"""SOLD's update: which loss moves what, where rollouts start, and that it learns."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch.distributions import Normal
from torch.utils._python_dispatch import TorchDispatchMode

from playslot_rl import keys
from playslot_rl.errors import ConfigError
from playslot_rl.methods.sold import losses
from playslot_rl.methods.sold.learner import SOLDLearner
from playslot_rl.methods.sold.losses import imagine
from playslot_rl.methods.sold.method import SOLDConfig
from playslot_rl.methods.sold.networks import sample_action
from playslot_rl.seeds.draws import StepGenerators
from playslot_rl.testing import tiny_config

Make = Callable[..., SOLDLearner]
NETWORKS = ("dynamics", "reward", "actor", "critic")


def _weights(learner: SOLDLearner) -> dict[str, torch.Tensor]:
    modules = {**learner.modules, "savi": learner.savi}
    return {f"{n}.{k}": v.clone() for n, module in modules.items() for k, v in module.state_dict().items()}


def _moved(learner: SOLDLearner, before: dict[str, torch.Tensor]) -> set[str]:
    return {key.split(".")[0] for key, value in _weights(learner).items() if not torch.equal(value, before[key])}


@pytest.mark.parametrize("name", NETWORKS)
def test_every_loss_moves_its_own_network(
    make_learner: Make, batch: TensorDict, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The update with the steps of the other networks left out still moves this one: its loss reaches it."""
    learner = make_learner()
    before, step = _weights(learner), learner._step
    monkeypatch.setattr(
        learner, "_step", lambda n, loss, keep=False: step(n, loss, keep) if n == name else torch.zeros(())
    )
    learner.update(batch, StepGenerators(0, 0))
    followers = {"returns"} | {"critic": {"slow_critic"}, "actor": {"mean_actor"}}.get(name, set())
    assert _moved(learner, before) == {name} | followers


def test_savi_is_untouched_even_by_the_image_loss(make_learner: Make, batch: TensorDict) -> None:
    learner = make_learner(image_weight=1.0)
    before = _weights(learner)
    metrics = learner.update(batch, StepGenerators(0, 0))
    assert metrics["image_mse"] > 0
    assert _moved(learner, before) == {*NETWORKS, "slow_critic", "mean_actor", "returns"}
    assert all(parameter.grad is None for parameter in learner.savi.parameters())


def test_the_image_loss_reaches_the_dynamics_through_the_frozen_decoder(make_learner: Make, batch: TensorDict) -> None:
    learner = make_learner(image_weight=1.0, slot_weight=0.0, decoded_frames=1)
    assert learner.stored == (keys.SLOTS, keys.PIXELS)
    assert learner.update(batch, StepGenerators(0, 0))["dynamics_grad_norm"] > 0


@pytest.mark.parametrize("sequence", [5, 6, 7, 8, 11])
def test_a_context_is_refused_that_some_sequence_across_episodes_holds_of_none(sequence: int) -> None:
    config, frames = tiny_config(max_steps=3), 4
    places = [Counter((first + i) // frames for i in range(sequence)) for first in range(frames)]
    longest = min(max(place.values()) for place in places)
    for context in range(1, sequence):
        own = SOLDConfig(sequence=sequence, context=context, least_context=1)
        with pytest.raises(ConfigError) if context > longest else nullcontext():
            own.check("baselines.sold", config)


@pytest.mark.slow
@pytest.mark.parametrize("gradient", ["dynamics", pytest.param("reinforce", marks=pytest.mark.slow)])
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


@pytest.mark.parametrize("decay", [0.0, 0.75])
def test_the_mean_actor_follows_at_its_rate_and_is_what_a_run_keeps(
    make_learner: Make, batch: TensorDict, decay: float
) -> None:
    learner = make_learner(actor_average=decay)
    old = {key: value.clone() for key, value in learner.mean_actor.state_dict().items()}
    learner.update(batch, StepGenerators(0, 0))
    for key, value in learner.networks.actor.state_dict().items():
        expected = decay * old[key] + (1 - decay) * value
        torch.testing.assert_close(
            learner.trained["actor"].state_dict()[key], expected, rtol=0, atol=1e-7 * (decay > 0)
        )


def test_the_last_weights_explore_and_their_average_is_evaluated(make_learner: Make, batch: TensorDict) -> None:
    learner = make_learner(actor_average=0.5, actor_lr=0.1)
    learner.update(batch, StepGenerators(0, 0))
    memory = learner.initial(1)
    memory[keys.PIXELS] = torch.zeros(1, 3, 64, 64, dtype=torch.uint8)
    slots = learner.act(memory, torch.Generator().manual_seed(0), explore=False)[keys.SLOTS].unsqueeze(1)
    best, _, _ = learner.mean_actor(slots)
    location, std, _ = learner.networks.actor(slots)
    sampled = sample_action(location[:, 0], std[:, 0], torch.Generator().manual_seed(0)).clamp(-1, 1)
    for explore, expected in ((False, best[:, 0]), (True, sampled)):
        seen = learner.act(memory, torch.Generator().manual_seed(0), explore)
        torch.testing.assert_close(seen[keys.ACTION], expected)


def test_the_first_updates_may_leave_actor_and_critic_alone(make_learner: Make, batch: TensorDict) -> None:
    learner = make_learner(world_model_updates=2)
    before = _weights(learner)
    learner.update(batch, StepGenerators(0, 1))
    assert _moved(learner, before) == {"dynamics", "reward"}
    learner.update(batch, StepGenerators(0, 2))
    assert {"actor", "critic"} <= _moved(learner, before)


@pytest.mark.integration
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


def test_imagined_steps_follow_from_the_dynamics_and_the_actors_whole_history(
    make_learner: Make, batch: TensorDict
) -> None:
    networks = make_learner().networks
    context, taken = batch[keys.SLOTS][:, :3], batch[keys.ACTION][:, 1:3]
    out = imagine(networks.dynamics, networks.actor, context, taken, 3, torch.Generator().manual_seed(0))
    torch.testing.assert_close(out.slots[:, :3], context)
    whole = networks.dynamics(out.slots[:, :-1], torch.cat((taken, out.actions), dim=1))
    torch.testing.assert_close(out.slots[:, 3:], whole[:, 2:])
    mean, std, _ = networks.actor(out.slots[:, :-1])
    torch.testing.assert_close(out.locations, mean[:, 2:])
    expected = Normal(mean[:, 2:], std[:, 2:]).log_prob(out.actions).sum(dim=-1)
    torch.testing.assert_close(out.log_probs, expected, atol=1e-4, rtol=1e-4)


def test_an_action_is_judged_by_what_follows_and_not_by_what_it_saw(make_learner: Make, batch: TensorDict) -> None:
    """sg(S) in a ~ pi(. | sg(S)): no gradient runs from the actions back into slots."""
    networks = make_learner().networks
    context = batch[keys.SLOTS][:, :2].clone().requires_grad_()
    out = imagine(networks.dynamics, networks.actor, context, batch[keys.ACTION][:, 1:2], 3)
    assert torch.autograd.grad(out.actions.sum(), context, allow_unused=True, retain_graph=True) == (None,)
    assert torch.autograd.grad(out.slots.sum(), context)[0].abs().max() > 0


class _Counting(torch.nn.Module):
    """A head whose value of a frame is the frame's number."""

    def __init__(self, scale: float) -> None:
        super().__init__()
        self.scale, self.weight = scale, torch.nn.Parameter(torch.ones(()))

    def forward(self, slots: torch.Tensor) -> torch.Tensor:
        number = torch.arange(slots.shape[1], dtype=slots.dtype).expand(slots.shape[:2])
        return (number * self.scale * self.weight + 0 * slots.flatten(2).sum(dim=2)).unsqueeze(-1)

    def decode(self, logits: torch.Tensor) -> torch.Tensor:
        return logits.squeeze(-1)

    def cross_entropy(self, logits: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        return logits.squeeze(-1) * 0 + values.detach() * 0


def test_dynamics_learn_from_what_lies_beyond_the_context_only(make_learner: Make, batch: TensorDict) -> None:
    """The prediction of a context frame is nobody's: its target may be anything."""
    learner = make_learner(context=3, least_context=3, image_weight=1.0, predicted_rewards=False)
    other = batch.clone()
    other[keys.PIXELS][:, :3] = 0
    wanted, got = (make_learner(**vars(learner.config))._model(b, StepGenerators(0, 0)) for b in (batch, other))
    assert wanted["image_mse"] == got["image_mse"]
    predicted = learner.networks.dynamics.rollout(batch[keys.SLOTS][:, :3], batch[keys.ACTION][:, 1:])[:, 2:]
    kept = losses.same_episode(batch[keys.IS_FIRST].squeeze(-1))[:, 3:]
    expected = (predicted - batch[keys.SLOTS][:, 3:]).square().mean(dim=(-2, -1))[kept].mean()
    torch.testing.assert_close(wanted["slot_mse"], expected.detach())


@pytest.mark.parametrize("predicted", [False, True])
def test_the_reward_head_learns_from_predicted_slots_only_if_asked(
    make_learner: Make, batch: TensorDict, predicted: bool
) -> None:
    """Where it does, what the dynamics predict is something to it."""
    moving, still = (make_learner(predicted_rewards=predicted) for _ in range(2))
    torch.nn.init.zeros_(still.networks.dynamics.head.weight)
    one, other = (learner._model(batch, StepGenerators(0, 0))["loss_reward"] for learner in (moving, still))
    assert bool(one != other) is predicted


class _Waits(TorchDispatchMode):
    """Refuses what needs a value on the host."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        assert not any(wait in func.name() for wait in ("_local_scalar_dense", "nonzero", "masked_select")), func.name()
        return func(*args, **(kwargs or {}))


def test_an_update_waits_for_no_value(make_learner: Make, batch: TensorDict, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.optim.Adam, "step", lambda self: None)  # it counts its steps on the host
    learner = make_learner(image_weight=1.0, decoded_frames=1)
    with _Waits():
        learner.update(batch, StepGenerators(0, 0))


def test_rewards_are_of_the_frames_reached_and_values_of_the_frames_left(
    make_learner: Make, batch: TensorDict, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After c context frames, numbered from 0: rewards of c ... c+H-1, values of c-1 ... c+H-2, targets one later."""
    learner = make_learner(horizon=3)
    for name, scale in (("reward", 1.0), ("critic", 100.0)):
        setattr(learner.networks, name, _Counting(scale))
        learner._adam[name] = torch.optim.Adam(learner.networks.parts[name].parameters(), lr=0.0)
    learner.slow_critic = _Counting(100.0)
    seen: dict[str, Any] = {}

    def keep(name: str, numbers: tuple[int, ...]) -> None:
        original = getattr(losses, name)

        def spy(*arguments: Any) -> Any:
            seen[name] = [arguments[i].detach()[0].flatten().tolist() for i in numbers]
            return original(*arguments)

        monkeypatch.setattr(losses, name, spy)

    keep("imagined_returns", (0, 1))
    keep("actor_loss", (2,))
    keep("value_loss", (1, 3))
    lengths = set()
    for step in range(6):
        c = learner._starts(batch, StepGenerators(0, step))[0].shape[1]
        learner._behaviour(batch, StepGenerators(0, step))
        reached, left = [float(c + i) for i in range(3)], [100.0 * (c - 1 + i) for i in range(3)]
        assert seen["imagined_returns"] == [reached, [100 * number for number in reached]]
        assert seen["actor_loss"] == [left]
        assert seen["value_loss"] == [left, left]
        lengths.add(c)
    assert len(lengths) > 1


@pytest.mark.integration
def test_the_reward_of_an_episodes_first_frame_is_nobodys(make_learner: Make, batch: TensorDict) -> None:
    absurd = batch.clone()
    absurd[keys.REWARD][batch[keys.IS_FIRST]] = 1e4
    wanted, got = (make_learner()._model(b, StepGenerators(0, 0))["loss_reward"] for b in (batch, absurd))
    assert wanted == got


def test_windows_are_consecutive_frames_and_start_anywhere(make_learner: Make) -> None:
    learner = make_learner(context=2, horizon=2)
    number = torch.arange(9).expand(5, 9)
    whole = TensorDict({"number": number}, [5, 9])
    drawn = [learner._window(whole, StepGenerators(0, step)) for step in range(20)]
    numbers = torch.cat([window["number"] for window, _ in drawn])
    assert numbers.shape[1] == 4
    assert bool((numbers.diff(dim=1) == 1).all())
    assert set(numbers[:, 0].tolist()) == set(range(6))
    assert {c for _, c in drawn} == {1, 2}


@pytest.mark.slow
def test_the_critic_finds_the_value_of_a_constant_reward(make_learner: Make) -> None:
    """r = 1 for ever at gamma 1/2 is worth 2, of which a horizon of 2 sees 1.5: the rest is the critic's own."""
    learner = make_learner(
        spread=False, gamma=0.5, model_lr=5e-3, critic_lr=5e-3, batch_size=16, starts=24, horizon=2, limit=3.0,
        mean="linear", critic_decay=0.5,
    )  # fmt: skip
    for step in range(150):
        learner.update(_line(step, constant=1.0), StepGenerators(0, step))
    critic = learner.networks.critic
    value = critic.decode(critic(_line(999)[keys.SLOTS]))[:, :3].mean()
    assert value.item() == pytest.approx(2.0, abs=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("gradient", ["dynamics", "reinforce"])
def test_an_action_that_moves_slots_towards_reward_is_found(make_learner: Make, gradient: str) -> None:
    """A world of one number: the action adds to it and the reward is that number. The policy learns to push it up."""
    learner = make_learner(
        spread=False, gamma=0.9, model_lr=5e-3, actor_lr=5e-3, critic_lr=5e-3, batch_size=16, starts=24, horizon=2,
        actor_gradient=gradient,
    )  # fmt: skip
    metrics: dict[str, Any] = {}
    for step in range(130):
        metrics = dict(learner.update(_line(step), StepGenerators(0, step)))
    location, _, _ = learner.networks.actor(_line(999)[keys.SLOTS])
    assert metrics["unexplained"] < 0.2
    assert location[:, :, 0].mean() > 0.5


def _line(seed: int, constant: float | None = None) -> TensorDict:
    """Sequences in which half the features of slot 0 are x, x' = x + a_0 / 2, reward x' (or `constant`)."""
    generator = torch.Generator().manual_seed(seed)
    actions = torch.rand(16, 6, 4, generator=generator) * 2 - 1
    start = torch.rand(16, 1, generator=generator) - 0.5
    x = start + torch.cat((torch.zeros(16, 1), actions[:, 1:, 0] / 2), dim=1).cumsum(dim=1)
    slots = torch.zeros(16, 6, 4, 32)
    slots[:, :, 0, :16], slots[:, :, 0, 16:] = x.unsqueeze(-1), 1.0  # by its ones the slot that moves can be told
    flags = torch.zeros(16, 6, 1, dtype=torch.bool)
    reward = x.unsqueeze(-1) if constant is None else torch.full((16, 6, 1), constant)
    values = {keys.SLOTS: slots, keys.ACTION: actions, keys.REWARD: reward, keys.IS_FIRST: flags}
    return TensorDict(values, [16, 6])
