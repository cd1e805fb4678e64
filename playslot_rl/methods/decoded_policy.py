"""A latent policy and its action decoder, as a finished stage stores them."""

from __future__ import annotations

from torch import nn

from playslot_rl.modules.action_decoder import ActionDecoder


class DecodedPolicy[Policy: nn.Module](nn.Module):
    PARTS = ("policy", "action_decoder")

    def __init__(self, policy: Policy, action_decoder: ActionDecoder) -> None:
        super().__init__()
        self.policy, self.action_decoder = policy, action_decoder
