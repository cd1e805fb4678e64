"""The agent as an actor: closed loop (simulation), open loop (imagination), and its slot oracle.

Shapes: E episodes, T agent steps, N slots, D slot width, Z latent-action width, A action width, H W image height and
width.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from playslot_rl import keys
from playslot_rl.acting.actor import PlannedActor, SlotActor
from playslot_rl.acting.imagination import ImaginationEnv
from playslot_rl.runs import Run
from playslot_rl.world_model import Agent, action_decoder_module, latent_policy_module, oracle_module


def playslot_actor(agent: Agent) -> SlotActor:
    """Observe, parse with SAVi's recurrent state, choose a latent action, decode it (paper, section "Learning
    behaviours")."""
    heads = (latent_policy_module(agent.policy), action_decoder_module(agent.action_decoder))
    return SlotActor(agent.world_model.savi, *heads)


def load_actor(run: Path, device: torch.device | str = "cpu") -> SlotActor:
    """The actor of a run with a trained policy; a CheckpointError as of `Run.load_agent`."""
    return playslot_actor(Run.open(run).load_agent(device))


def oracle_actor(agent: Agent) -> SlotActor:
    """The slot oracle beside the agent, which gives real actions; a ValueError where there is none."""
    if agent.oracle is None:
        raise ValueError("oracle_actor: got an agent without a slot oracle, expected one trained with behaviour.oracle")
    return SlotActor(agent.world_model.savi, oracle_module(agent.oracle))


class Imagination(NamedTuple):
    """An imagined rollout: slots (E, T + 1, N, D), the first given or parsed; the policy's latents (E, T, Z); and
    decoded actions (E, T, A) in [-1, 1].
    """

    slots: Tensor
    latents: Tensor
    actions: Tensor


@torch.no_grad()
def imagine(agent: Agent, first: TensorDictBase, steps: int, generator: torch.Generator | None = None) -> Imagination:
    """Unfold the policy for T steps in latent space: nothing is observed after `first`, SLOTS (E, N, D) or PIXELS
    (E, 3, H, W) on the agent's device.

    The latents are decoded alone: a decoder that reads slots learned from those that it sees when it acts, and imagined
    ones mislead it (docs/notebook/labels.md).
    """
    env = ImaginationEnv(agent.world_model, first.batch_size, generator=generator)
    start = env.reset(first)
    policy = latent_policy_module(agent.policy)
    rollout = env.rollout(steps, policy, tensordict=start, auto_reset=False, break_when_any_done=False)
    slots = torch.cat([start[keys.SLOTS].unsqueeze(1), rollout["next", keys.SLOTS]], 1)
    latents = rollout[keys.LATENT_ACTION]
    return Imagination(slots, latents, agent.action_decoder(latents))


class ImaginationActor(PlannedActor):
    """Executes the actions of a rollout of T imagined steps; the frames that follow the first are never looked at.

    The rollout's slots stay in the memory, PREDICTED_SLOTS (n, T + 1, N, D), for pictures.
    """

    looks = "first"

    def __init__(self, agent: Agent, steps: int) -> None:
        super().__init__(steps, agent.world_model.env.action_dim, (keys.PREDICTED_SLOTS,), (keys.PIXELS,))
        self.agent = agent
        self._generator: torch.Generator | None = None

    def reset(self, seeds: Sequence[int]) -> TensorDict:
        """Nothing imagined yet; initial slots that are sampled depend on the first seed."""
        self._generator = torch.Generator(self.device).manual_seed(seeds[0])
        memory = super().reset(seeds)
        shape = (len(seeds), self.steps + 1, *self.agent.world_model.slot_shape)
        memory[keys.PREDICTED_SLOTS] = torch.zeros(shape)
        return memory

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Imagine the whole episode at its first frame; then the step's action."""
        fresh = tensordict.get(keys.STEP_COUNT).squeeze(-1) == 0
        if bool(fresh.any()):
            imagined = imagine(self.agent, tensordict.select(keys.PIXELS)[fresh], self.steps, self._generator)
            found = {keys.PLANNED_ACTIONS: imagined.actions, keys.PREDICTED_SLOTS: imagined.slots}
            for key, value in found.items():
                whole = tensordict.get(key).clone()
                whole[fresh] = value
                tensordict.set(key, whole)
        return super().forward(tensordict)
