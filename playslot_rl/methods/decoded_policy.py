"""A latent policy and its action decoder, as a finished stage stores them."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import nn

from playslot_rl.modules.action_decoder import ActionDecoder
from playslot_rl.storage.checkpoints import StageCheckpoint


class DecodedPolicy[Policy: nn.Module](nn.Module):
    def __init__(self, policy: Policy, action_decoder: ActionDecoder) -> None:
        super().__init__()
        self.policy, self.action_decoder = policy, action_decoder

    @classmethod
    def load(
        cls,
        done: StageCheckpoint,
        policy: Callable[[], Policy],
        latent_dim: int,
        state_dim: int,
        device: torch.device | str,
    ) -> DecodedPolicy[Policy]:
        """Those of a finished stage, frozen; `policy` builds an untrained one, whose features are `state_dim` wide."""
        model, env = done.sizes

        def build() -> DecodedPolicy[Policy]:
            return cls(policy(), ActionDecoder(model.action_decoder, latent_dim, env.action_dim, state_dim))

        return done.restore(build, ("policy", "action_decoder"), device)
