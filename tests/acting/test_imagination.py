"""The world model as an environment."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs.utils import check_env_specs
from waits import no_waits

from playslot_rl import keys
from playslot_rl.acting.agent import imagine as unfold
from playslot_rl.acting.imagination import ImaginationEnv, ImaginationSession
from playslot_rl.config import LatentMode
from playslot_rl.frames import normalise
from playslot_rl.testing import tiny_agent, tiny_config
from playslot_rl.world_model import Agent, WorldModel, _Step, dynamics_module, latent_policy_module

CONTEXT = 4


@pytest.fixture(scope="module")
def agent() -> Agent:
    return tiny_agent(tiny_config(context=CONTEXT))


def slots_of(batch: tuple[int, ...], seed: int = 0) -> Tensor:
    return torch.randn(*batch, 4, 32, generator=torch.Generator().manual_seed(seed))


def from_slots(env: ImaginationEnv, slots: Tensor) -> TensorDict:
    return env.reset(TensorDict({keys.SLOTS: slots}, slots.shape[:-2]))


def imagine(env: ImaginationEnv, agent: Agent, slots: Tensor, steps: int) -> TensorDict:
    policy = latent_policy_module(agent.policy)
    return env.rollout(steps, policy, tensordict=from_slots(env, slots), auto_reset=False)


@pytest.mark.parametrize("batch", [(), (3,), (2, 2)])
@pytest.mark.parametrize("horizon", [0, 2])
def test_specs_hold_batched_and_unbatched(agent: Agent, batch: tuple[int, ...], horizon: int) -> None:
    env = ImaginationEnv(agent.world_model, batch_size=batch, horizon=horizon)
    check_env_specs(env, break_when_any_done="both")


def by_hand(model: WorldModel, agent: Agent, first: Tensor, steps: int) -> tuple[Tensor, Tensor]:
    """Policy, split and predictor called one after the other on a growing, then sliding, window."""
    frames, latents = [first], []
    for _ in range(steps):
        latents.append(agent.policy(frames[-1]))
        window = torch.stack(frames[-CONTEXT:], 1)
        p, v = model.inverse_dynamics.split(torch.stack(latents[-CONTEXT:], 1))
        frames.append(model.predictor(window, p, v)[:, -1])
    return torch.stack(frames[1:], 1), torch.stack(latents, 1)


@torch.no_grad()
@pytest.mark.parametrize("steps", [CONTEXT - 1, CONTEXT, 3 * CONTEXT])
def test_a_rollout_equals_calling_the_modules_by_hand(agent: Agent, steps: int) -> None:
    first = slots_of((3,))
    rollout = imagine(ImaginationEnv(agent.world_model, batch_size=[3]), agent, first, steps)
    slots, latents = by_hand(agent.world_model, agent, first, steps)
    assert (slots[:, 1:] - slots[:, :-1]).abs().amax() > 1e-2, "a model that moves nothing proves nothing"
    torch.testing.assert_close(rollout["next", keys.SLOTS], slots, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(rollout[keys.LATENT_ACTION], latents, atol=1e-5, rtol=1e-5)


@torch.no_grad()
@pytest.mark.parametrize("mode", ["hybrid", "discrete", "continuous", "ground_truth"])
@pytest.mark.parametrize("steps", [3, 10])
def test_given_latents_the_environment_is_the_cached_rollout(mode: LatentMode, steps: int) -> None:
    model = tiny_agent(tiny_config(mode, context=CONTEXT)).world_model
    check_against_rollout(model, steps)


@torch.no_grad()
def test_one_latent_action_per_slot_goes_the_same_way() -> None:
    config = tiny_config(multi=True, context=CONTEXT)
    torch.manual_seed(0)
    model = WorldModel(config.model, config.env)
    model.inverse_dynamics.split(torch.randn(64, 8))
    assert model.latent_shape == (4, 8)
    check_against_rollout(model.eval(), 7)
    check_env_specs(ImaginationEnv(model, batch_size=[2]))


@torch.no_grad()
def test_a_world_model_on_ocvp_seq_goes_the_same_way() -> None:
    config = tiny_config(context=CONTEXT)
    predictor = replace(config.model.predictor, kind="ocvp_seq")
    other = tiny_agent(replace(config, model=replace(config.model, predictor=predictor)))
    check_against_rollout(other.world_model, 7)
    check_env_specs(ImaginationEnv(other.world_model, batch_size=[2]))
    check_unequal_ages(other)


def check_against_rollout(model: WorldModel, steps: int) -> None:
    z = torch.randn(2, steps, *model.latent_shape, generator=torch.Generator().manual_seed(1))
    env = ImaginationEnv(model, batch_size=[2])
    first, got = slots_of((2,)), []
    state = from_slots(env, first)
    for t in range(steps):
        state = env.step(state.set(keys.LATENT_ACTION, z[:, t]))["next"]
        got.append(state[keys.SLOTS])
    p, v = model.inverse_dynamics.split(z)
    expected = model.predictor.rollout(first[:, None], p, v)
    torch.testing.assert_close(torch.stack(got, 1), expected, atol=1e-5, rtol=1e-5)


@torch.no_grad()
def test_episodes_of_unequal_age_do_not_disturb_each_other(agent: Agent) -> None:
    check_unequal_ages(agent)


def check_unequal_ages(agent: Agent) -> None:
    env = ImaginationEnv(agent.world_model, batch_size=[2])
    policy = latent_policy_module(agent.policy)
    old = imagine(env, agent, slots_of((2,), 1), 3)[:, -1]["next"]
    young = from_slots(env, slots_of((2,), 2))
    mixed = torch.where(torch.tensor([True, False]), old.select(*young.keys()), young)
    assert mixed[keys.HISTORY_LENGTH].flatten().tolist() == [4, 1]
    after = env.step(policy(mixed.clone()))["next", keys.SLOTS]
    alone = [env.step(policy(part.clone()))["next", keys.SLOTS] for part in (old, young)]
    torch.testing.assert_close(after[0], alone[0][0], atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(after[1], alone[1][1], atol=1e-5, rtol=1e-5)


def test_a_reset_takes_slots_pixels_or_the_sampler(agent: Agent) -> None:
    drawn = slots_of((2,), 5)
    env = ImaginationEnv(agent.world_model, batch_size=[2], first_slots=lambda n: drawn[:n])
    assert torch.equal(env.reset()[keys.SLOTS], drawn)
    given = slots_of((2,), 6)
    assert torch.equal(env.reset(TensorDict({keys.SLOTS: given}, [2]))[keys.SLOTS], given)
    pixels = torch.randint(256, (2, 3, 64, 64), dtype=torch.uint8)
    with torch.no_grad():
        parsed, _ = agent.world_model.savi(normalise(pixels[:, None]))
    start = env.reset(TensorDict({keys.PIXELS: pixels}, [2]))
    torch.testing.assert_close(start[keys.SLOTS], parsed[:, 0])
    torch.testing.assert_close(start[keys.SLOT_HISTORY][:, -1], start[keys.SLOTS])
    assert start[keys.SLOT_HISTORY][:, :-1].abs().max() == 0


def test_slots_of_another_shape_are_refused(agent: Agent) -> None:
    env = ImaginationEnv(agent.world_model, batch_size=[2])
    with pytest.raises(ValueError, match=r"got shape \(2, 3, 32\), expected \(2, 4, 32\)"):
        env.reset(TensorDict({keys.SLOTS: torch.zeros(2, 3, 32)}, [2]))
    with pytest.raises(ValueError, match="horizon: got -1"):
        ImaginationEnv(agent.world_model, horizon=-1)


def test_other_batch_sizes_than_the_declared_one_are_taken(agent: Agent) -> None:
    rollout = imagine(ImaginationEnv(agent.world_model), agent, slots_of((5,)), 2)
    assert rollout["next", "done"].shape == (5, 2, 1)


def test_the_horizon_truncates_and_nothing_else_ends_an_episode(agent: Agent) -> None:
    rollout = imagine(ImaginationEnv(agent.world_model, [2], horizon=3), agent, slots_of((2,)), 9)
    assert rollout.shape == (2, 3)
    assert rollout["next", "truncated"][..., 0].tolist() == [[False, False, True]] * 2
    assert not rollout["next", "terminated"].any()
    endless = imagine(ImaginationEnv(agent.world_model, [2]), agent, slots_of((2,)), 9)
    assert endless.shape == (2, 9)
    assert not endless["next", "done"].any()


def test_gradients_reach_the_policy_only_when_asked(agent: Agent) -> None:
    for differentiable in (False, True):
        env = ImaginationEnv(agent.world_model, [2], differentiable=differentiable)
        agent.policy.zero_grad()
        last = imagine(env, agent, slots_of((2,)), 3)["next", keys.SLOTS][:, -1]
        assert last.requires_grad is differentiable
        if differentiable:
            last.square().mean().backward()
            assert agent.policy.head.weight.grad is not None
            assert agent.policy.head.weight.grad.abs().sum() > 0


def test_imagining_changes_neither_the_model_nor_its_input(agent: Agent) -> None:
    before = {name: tensor.clone() for name, tensor in agent.state_dict().items()}
    env = ImaginationEnv(agent.world_model, [2])
    start = from_slots(env, slots_of((2,)))
    kept = start.clone()
    env.rollout(5, latent_policy_module(agent.policy), tensordict=start, auto_reset=False)
    for key in sorted(kept.keys()):
        assert torch.equal(start[key], kept[key]), key
    assert all(torch.equal(before[name], tensor) for name, tensor in agent.state_dict().items())
    assert not agent.world_model.training


@torch.no_grad()
def test_histories_are_right_aligned_and_slide(agent: Agent) -> None:
    model = agent.world_model
    step = dynamics_module(model)
    env = ImaginationEnv(model, [1])
    state = from_slots(env, slots_of((1,)))
    seen = [state[keys.SLOTS]]
    for t in range(CONTEXT + 2):
        z = torch.full((1, 8), float(t))
        state = step(state.clone().set(keys.LATENT_ACTION, z))
        seen.append(state[keys.SLOTS])
        length = min(t + 2, CONTEXT)
        assert state[keys.HISTORY_LENGTH].item() == length
        torch.testing.assert_close(state[keys.SLOT_HISTORY][:, -length:], torch.stack(seen[-length:], 1))
        assert state[keys.ACTION_HISTORY][0, -2, 0].item() == t
        assert state[keys.ACTION_HISTORY][0, -1].abs().max() == 0


def test_a_session_is_the_rollout_step_by_step_and_goes_back_where_it_was(agent: Agent) -> None:
    session, model = ImaginationSession(agent.world_model), agent.world_model
    z = torch.randn(2, 12, *model.latent_shape, generator=torch.Generator().manual_seed(0))  # past the context of 8
    session.reset(slots=slots_of((2,)))
    imagined = []
    for t in range(12):
        if t == 3:
            here = session.state
        imagined.append(session.step(z[:, t]))
    with torch.no_grad():
        expected = model.predictor.rollout(slots_of((2,))[:, None], *model.inverse_dynamics.split(z))
    torch.testing.assert_close(torch.stack(imagined, 1), expected, atol=1e-5, rtol=1e-4)
    session.restore(here)
    assert torch.equal(session.slots, imagined[2])
    assert torch.equal(session.step(z[:, 3]), imagined[3])
    session.restore(here)  # the kept state was not changed by going on from it
    assert torch.equal(session.step(z[:, 3]), imagined[3])


def test_a_session_takes_frames_prototypes_and_candidates(agent: Agent) -> None:
    session, model = ImaginationSession(agent.world_model), agent.world_model
    frames = torch.randint(256, (2, 3, 64, 64), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        torch.testing.assert_close(session.reset(frames=frames), model.savi(frames[:, None] / 255)[0][:, 0])
    here = session.state
    one = session.step(prototypes=[4, 1])
    session.restore(here)
    assert torch.equal(session.step(model.inverse_dynamics.prototypes[torch.tensor([4, 1])]), one)
    session.restore(here)
    session.branch(3)
    z = torch.randn(6, *model.latent_shape, generator=torch.Generator().manual_seed(1))
    many = session.step(z)
    for episode in range(2):
        for way in range(3):
            session.restore(here[episode : episode + 1])
            alone = session.step(z[3 * episode + way][None])
            torch.testing.assert_close(alone[0], many[3 * episode + way], atol=1e-5, rtol=1e-4)


def test_a_session_refuses_what_does_not_fit_in_one_line(agent: Agent) -> None:
    session = ImaginationSession(agent.world_model)
    with pytest.raises(ValueError, match="call reset"):
        session.step(prototypes=[0])
    with pytest.raises(ValueError, match="expected one of them"):
        session.reset()
    session.reset(slots=slots_of((2,)))
    with pytest.raises(ValueError, match="got prototypes"):
        session.step(prototypes=[0, 99])
    with pytest.raises(ValueError, match="one for each of 2 episodes"):
        session.step(prototypes=[0])
    with pytest.raises(ValueError, match="expected one of them"):
        session.step(torch.zeros(2, 8), prototypes=[0, 1])


def nearness(slots: Tensor) -> Tensor:
    return -slots.square().mean((-2, -1))[..., None]


@pytest.mark.parametrize("batch", [(), (2, 2)])
def test_a_reward_is_that_of_the_slots_a_step_leads_to(agent: Agent, batch: tuple[int, ...]) -> None:
    env = ImaginationEnv(agent.world_model, batch_size=batch, reward=nearness)
    check_env_specs(env, break_when_any_done="both")
    rollout = imagine(env, agent, slots_of(batch), 3)
    assert torch.equal(rollout["next", "reward"], nearness(rollout["next", keys.SLOTS]))
    assert rollout["next", "reward"].unique().numel() > 1


def test_a_reward_can_be_learned_through(agent: Agent) -> None:
    env = ImaginationEnv(agent.world_model, [2], differentiable=True, reward=nearness)
    first = slots_of((2,)).requires_grad_()
    rewards = imagine(env, agent, first, 2)["next", "reward"]
    assert torch.autograd.grad(rewards.sum(), first)[0].abs().sum() > 0


def test_without_a_reward_there_is_none_to_learn_from(agent: Agent) -> None:
    """Zeros would be learned from in silence."""
    env = ImaginationEnv(agent.world_model, [2])
    assert env.reward_keys == []
    rollout = imagine(env, agent, slots_of((2,)), 2)
    assert rollout["next"].get("reward", None) is None
    with pytest.raises(KeyError, match='"reward" not found'):
        rollout["next", "reward"]


def test_a_reward_of_another_shape_is_refused(agent: Agent) -> None:
    env = ImaginationEnv(agent.world_model, [2], reward=lambda slots: slots.mean((-2, -1)))
    with pytest.raises(ValueError, match=r"reward: got shape \(2,\) of slots \(2, 4, 32\), expected \(2, 1\)"):
        imagine(env, agent, slots_of((2,)), 1)


def test_imagined_steps_read_no_value(agent: Agent, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a GPU, which leaves no frames out."""
    monkeypatch.setattr(_Step, "_predicted", lambda step, *histories: step.world_model.next_slots(*histories))
    first = TensorDict({keys.SLOTS: slots_of((2,))}, [2])
    start, session = ImaginationEnv(agent.world_model, [2]).reset(first), ImaginationSession(agent.world_model)
    session.reset(slots=first[keys.SLOTS])
    expected = unfold(agent, first, 6)
    monkeypatch.setattr(ImaginationEnv, "reset", lambda env, given: start.clone())  # TorchRL's own reads
    with no_waits(), torch.no_grad():
        found = unfold(agent, first, 6)
        played = [session.step(found.latents[:, step]) for step in range(6)]
    assert torch.equal(found.slots, expected.slots)
    torch.testing.assert_close(torch.stack(played, 1), expected.slots[:, 1:], atol=1e-5, rtol=1e-4)
