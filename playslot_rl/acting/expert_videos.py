"""The expert's own videos through the latent actions: parsed, inferred, decoded and executed without looking.

    S_0..S_T = SAVi(x_0..x_T),    z_t = InvDyn(S_t, S_{t+1}),    a_t = D_a(z_t)

Beside imagination, whose latents come from the policy on predicted slots, everything but the decoder is the truth here:
what fails is lost between a motion that was seen and the actions that made it.

Shapes: n episodes, T agent steps, A action width, H W image height and width.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor

from playslot_rl import keys
from playslot_rl.acting.actor import ExpertActor, PlannedActor
from playslot_rl.acting.episodes import Moment, TaskPool, record
from playslot_rl.frames import normalise
from playslot_rl.world_model import Agent


class Performance(NamedTuple):
    """Whole episodes of the expert: frames (n, T + 1, 3, H, W) uint8 [0, 255] and actions (n, T, A) in [-1, 1]."""

    frames: Tensor
    actions: Tensor


def perform(pool: TaskPool, seeds: Sequence[int]) -> Performance:
    """Let the scripted expert play episodes, none of which starts solved, to their last step, and film it."""
    actions = torch.zeros(len(seeds), pool.env.max_steps, pool.env.action_dim)

    def note(moment: Moment) -> None:
        if moment.seen is not None:
            actions[list(moment.episodes), moment.step] = moment.seen[keys.ACTION].float().cpu()

    frames, _ = record(pool, ExpertActor(), seeds, note)
    return Performance(torch.from_numpy(frames).movedim(-1, -3), actions.clamp(-1, 1))


class ReplayActor(PlannedActor):
    """Executes what the latents of the expert's videos decode to, decoded alone as in imagination; the policy is not
    asked.
    """

    def __init__(self, agent: Agent, performed: Callable[[Sequence[int]], Performance]) -> None:
        env = agent.world_model.env
        super().__init__(env.max_steps, env.action_dim)
        self.agent, self.performed = agent, performed

    @torch.no_grad()
    def reset(self, seeds: Sequence[int]) -> TensorDict:
        """Plan whole episodes; initial slots that are sampled depend on the first seed."""
        memory, model = super().reset(seeds), self.agent.world_model
        frames, actions = (part.to(self.device) for part in self.performed(seeds))
        generator = torch.Generator(self.device).manual_seed(seeds[0])
        slots, _ = model.savi(normalise(frames), generator=generator)
        memory[keys.PLANNED_ACTIONS] = self.agent.action_decoder(model.inverse_dynamics(slots, actions).z)
        return memory
