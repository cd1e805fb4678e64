"""A trained LAPO run as an actor: frame to latent action by the latent policy, to a real action by the decoder."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from playslot_rl.acting.actor import Actor, latent_actor
from playslot_rl.frames import normalise
from playslot_rl.methods.decoded_policy import DecodedPolicy
from playslot_rl.methods.lapo.config import LAPOConfig
from playslot_rl.methods.lapo.method import MODEL, NAME
from playslot_rl.methods.lapo.model import EncoderMLP
from playslot_rl.runs import Run


class LAPOPolicy(nn.Module):
    """LAPO's latent policy: frames (B, 3, H, W), uint8 or float [0, 1], to latent actions (B, Z)."""

    def __init__(self, config: LAPOConfig, image_size: int) -> None:
        super().__init__()
        self.network = EncoderMLP(3, config.channels, image_size, config.hidden, config.latent_dim)

    def forward(self, pixels: Tensor) -> Tensor:
        z: Tensor = self.network(normalise(pixels))
        return z


def load_actor(run: Run, device: torch.device | str = "cpu") -> Actor:
    """The actor of a finished run; a CheckpointError where it is missing, damaged, or of another inverse model."""
    done = run.stage(NAME, MODEL.name)
    own, size = done.group(LAPOConfig, NAME), done.sizes[1].image_size
    parts = DecodedPolicy.load(done, lambda: LAPOPolicy(own, size), own.latent_dim, device)
    return latent_actor(parts.policy, parts.action_decoder)
