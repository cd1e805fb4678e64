"""Acting on what the world model believes of the slots, not on what one frame shows: a filter of fixed gain K.

    p_t = cOCVP(b_{<t}, z_{<t}),   b_t = p_t + K (s_t - p_t),   z_t = f_pi(b_t),   b_0 = s_0

s_t is what SAVi parses. K = 1 is the paper's policy, which has no memory; K = 0 looks at the first frame alone, as
imagination does. Between them the policy knows how far it has come where a frame does not show it, or shows it badly.

Note: not in the paper. A policy in one of TorchRL's environments (`acting.simulation`) sees parsed slots.

Shapes: n episodes, N slots, D slot width, Z latent-action width, C context frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import torch
from tensordict import TensorDict, TensorDictBase

from playslot_rl import keys
from playslot_rl.acting.actor import SlotActor
from playslot_rl.world_model import Agent, action_decoder_module, dynamics_module, latent_policy_module

PAST: Final = (keys.LATENT_ACTION, keys.SLOT_HISTORY, keys.ACTION_HISTORY, keys.HISTORY_LENGTH)
"""What `dynamics_module` reads: beliefs and latents of the steps before."""


class BeliefActor(SlotActor):
    """PlaySlot's policy on beliefs, of gain `agent.policy.gain`; a decoder that reads slots reads the parsed ones."""

    def __init__(self, agent: Agent) -> None:
        decoder = action_decoder_module(agent.action_decoder)
        super().__init__(agent.world_model.savi, decoder, policy=agent.policy, memory=PAST)
        self.policy, self.dynamics = latent_policy_module(agent.policy), dynamics_module(agent.world_model)
        self.gain = agent.policy.gain
        self._context, self._latent = agent.world_model.config.predictor.context, agent.world_model.latent_shape

    def reset(self, seeds: Sequence[int]) -> TensorDict:
        """No past: HISTORY_LENGTH (n, 1) is 0."""
        memory, n, context = super().reset(seeds), len(seeds), self._context
        shapes = ((n, *self._latent), (n, context, *self._slots), (n, context, *self._latent))
        memory.update({key: torch.zeros(shape) for key, shape in zip(PAST, shapes, strict=False)})
        memory[keys.HISTORY_LENGTH] = torch.zeros(n, 1, dtype=torch.long)
        return memory

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        seen = self.see(tensordict)
        parsed, moved = seen[keys.SLOTS], seen.copy()
        first = moved[keys.HISTORY_LENGTH] == 0
        moved[keys.HISTORY_LENGTH] = moved[keys.HISTORY_LENGTH].clamp(min=1)  # of a first frame nothing is predicted
        predicted = self.dynamics(moved)[keys.SLOTS]
        moved[keys.SLOTS] = torch.where(first[..., None], parsed, predicted + self.gain * (parsed - predicted))
        moved[keys.SLOT_HISTORY][:, -1] = moved[keys.SLOTS]
        moved[keys.HISTORY_LENGTH] = torch.where(first, 1, moved[keys.HISTORY_LENGTH])
        return self.heads(self.policy(moved).set(keys.SLOTS, parsed))
