"""The simulator seen through the world model."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from playslot_rl import keys
from playslot_rl.acting.imagination import ImaginationEnv
from playslot_rl.acting.simulation import latent_env, make_simulation_env
from playslot_rl.config import RenderConfig
from playslot_rl.testing import tiny_agent, tiny_config
from playslot_rl.world_model import Agent, action_decoder_module, latent_policy_module

STEPS = 4


class SquareEnv(EnvBase):
    """A square that the action pushes across a black frame: a task without a simulator. Ends after `length` steps."""

    def __init__(self, length: int = 100, side: int = 64, width: int = 4, start: int = 0) -> None:
        super().__init__(device="cpu", batch_size=torch.Size([]))
        self.length, self.side, self.at, self.count, self.start = length, side, torch.zeros(2), 0, start
        pixels = Unbounded((3, side, side), dtype=torch.uint8)
        self.observation_spec = Composite({keys.PIXELS: pixels, "executed": Unbounded((width,))})
        self.action_spec = Composite({keys.ACTION: Bounded(-1, 1, (width,))})
        self.reward_spec = Unbounded((1,))

    def _observe(self, action: torch.Tensor) -> dict[str, torch.Tensor]:
        frame = torch.zeros(3, self.side, self.side, dtype=torch.uint8)
        x, y = (self.at.clamp(-1, 1) * 20 + 24).int().tolist()
        frame[:, y : y + 12, x : x + 12] = 200
        return {keys.PIXELS: frame, "executed": action.clone()}

    def _reset(self, tensordict: TensorDictBase | None, **kwargs: Any) -> TensorDictBase:
        self.at, self.count = torch.full((2,), 0.2 * self.start), 0
        return TensorDict(self._observe(torch.zeros(self.action_spec.shape[-1])))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict[keys.ACTION]
        self.at, self.count = self.at + action[:2], self.count + 1
        done = torch.tensor([self.count >= self.length])
        return TensorDict({**self._observe(action), "reward": torch.zeros(1), "done": done, "terminated": done})

    def _set_seed(self, seed: int | None) -> None:
        pass


@pytest.fixture(scope="module", params=[False, True], ids=["latent", "latent and slots"])
def agent(request: pytest.FixtureRequest) -> Agent:
    """Untrained; its decoder reads the latent action alone, or the slots too."""
    config = tiny_config(max_steps=STEPS)
    decoder = replace(config.model.action_decoder, reads_slots=request.param, state_dim=8, state_heads=2)
    return tiny_agent(replace(config, model=replace(config.model, action_decoder=decoder)))


def square_env(agent: Agent, max_steps: int = STEPS, length: int = 100, start: int = 0) -> TransformedEnv:
    return latent_env(SquareEnv(length, start=start), agent.world_model, agent.action_decoder, max_steps)


@pytest.mark.integration
def test_specs_hold_unbatched_and_batched_from_inside_and_outside(agent: Agent) -> None:
    check_env_specs(square_env(agent))
    check_env_specs(SerialEnv(2, lambda: square_env(agent)))
    batched = latent_env(SerialEnv(2, SquareEnv), agent.world_model, agent.action_decoder, STEPS)
    check_env_specs(batched, break_when_any_done="both")


@torch.no_grad()
def test_slots_are_those_of_the_whole_clip_parsed_at_once(agent: Agent) -> None:
    rollout = square_env(agent).rollout(STEPS, latent_policy_module(agent.policy))
    assert rollout.shape == (STEPS,), "the step counter truncates"
    frames = torch.cat([rollout[keys.PIXELS][:1], rollout["next", keys.PIXELS]])[None]
    assert not torch.equal(frames[0, 0], frames[0, -1]), "a frame that stays the same proves nothing"
    slots, state = agent.world_model.savi(frames.float().div(255))
    torch.testing.assert_close(rollout["next", keys.SLOTS], slots[0, 1:], atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(rollout["next", keys.SLOT_STATE][-1], state[0], atol=1e-5, rtol=1e-5)
    assert rollout["next", keys.SLOT_AGE].flatten().tolist() == [2, 3, 4, 5]


@torch.no_grad()
def test_the_task_gets_the_decoded_latent_action(agent: Agent) -> None:
    rollout = square_env(agent).rollout(STEPS, latent_policy_module(agent.policy))
    expected = action_decoder_module(agent.action_decoder)(rollout.clone())[keys.ACTION]
    torch.testing.assert_close(rollout["next", "executed"], expected)
    torch.testing.assert_close(rollout[keys.LATENT_ACTION], agent.policy(rollout[keys.SLOTS]), atol=1e-5, rtol=1e-5)


@torch.no_grad()
def test_batched_episodes_equal_single_ones(agent: Agent) -> None:
    policy = latent_policy_module(agent.policy)
    single = [square_env(agent, start=start).rollout(STEPS, policy) for start in (0, 1)]
    makers = [lambda start=start: SquareEnv(start=start) for start in (0, 1)]
    batched = latent_env(SerialEnv(2, makers), agent.world_model, agent.action_decoder, STEPS).rollout(STEPS, policy)
    for row, alone in zip(batched, single, strict=True):
        torch.testing.assert_close(row["next", keys.SLOTS], alone["next", keys.SLOTS], atol=1e-5, rtol=1e-5)
    assert not torch.allclose(single[0]["next", keys.SLOTS], single[1]["next", keys.SLOTS])


@torch.no_grad()
def test_a_partial_reset_starts_only_its_own_episode_anew(agent: Agent) -> None:
    makers = [lambda length=length: SquareEnv(length) for length in (2, 100)]
    env = latent_env(SerialEnv(2, makers), agent.world_model, agent.action_decoder, 100)
    rollout = env.rollout(5, latent_policy_module(agent.policy), break_when_any_done=False)
    assert rollout[keys.SLOT_AGE][..., 0].tolist() == [[1, 2, 1, 2, 1], [1, 2, 3, 4, 5]]
    torch.testing.assert_close(rollout[0, 2][keys.SLOTS], rollout[0, 0][keys.SLOTS])


@torch.no_grad()
def test_the_recurrent_state_lives_in_the_tensordict(agent: Agent) -> None:
    env, policy = square_env(agent), latent_policy_module(agent.policy)
    parse = env.transform[0].parser
    kept = env.rollout(2, policy)[-1]["next"].clone()
    env.rollout(3, policy)  # another episode in between leaves no trace
    frame = torch.zeros(3, 64, 64, dtype=torch.uint8)
    entries = TensorDict({keys.PIXELS: frame, **{k: kept[k] for k in (keys.SLOT_STATE, keys.SLOT_AGE)}})
    expected, _ = agent.world_model.savi(frame[None, None].float(), kept[keys.SLOT_STATE][None])
    torch.testing.assert_close(parse(entries)[keys.SLOTS], expected[0, 0], atol=1e-5, rtol=1e-5)


def test_a_task_of_another_shape_is_refused(agent: Agent) -> None:
    with pytest.raises(ValueError, match=r"frames: got \(3, 32, 32\), expected \(3, 64, 64\)"):
        latent_env(SquareEnv(side=32), agent.world_model, agent.action_decoder, STEPS)
    with pytest.raises(ValueError, match="actions: got width 2, expected 4"):
        latent_env(SquareEnv(width=2), agent.world_model, agent.action_decoder, STEPS)


@pytest.mark.integration
@torch.no_grad()
def test_one_policy_module_acts_on_the_real_task_and_in_imagination(agent: Agent) -> None:
    config, policy = tiny_config(max_steps=STEPS), latent_policy_module(agent.policy)
    env = make_simulation_env(config.env, RenderConfig(), agent.world_model, agent.action_decoder)
    try:
        check_env_specs(env)
        env.set_seed(3)
        start = env.reset()
        simulated = env.rollout(9, policy, tensordict=start.clone(), auto_reset=False)
        env.set_seed(3)
        again = env.rollout(9, policy)
    finally:
        env.close()
    assert simulated["next", keys.SUCCESS].dtype == torch.bool
    assert simulated["next", "truncated"][..., 0].tolist() == [False] * (STEPS - 1) + [True]
    torch.testing.assert_close(simulated["next", keys.SLOTS], again["next", keys.SLOTS])
    dream = ImaginationEnv(agent.world_model)
    imagined = dream.rollout(STEPS, policy, tensordict=dream.reset(start.select(keys.PIXELS)), auto_reset=False)
    torch.testing.assert_close(imagined[keys.LATENT_ACTION][0], simulated[keys.LATENT_ACTION][0], atol=1e-5, rtol=1e-5)
    assert imagined[keys.LATENT_ACTION].shape == simulated[keys.LATENT_ACTION].shape
