"""The autoencoder, and the policy on its frozen code.

    o^ = D(E(o)),   a = f((E(o) - m) / s + P)

E gives a map of codes, whose h w places take that of the slots in the policy's network f; m and s are their mean and
deviation on the demonstrations, P is a learned position of each, as the ResNet Oracle has it.

Shapes: B batch, H W image height and width, h w = H / 2^L, W / 2^L with L levels, C code width, A action dim.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn

from playslot_rl import keys
from playslot_rl.acting.actor import Actor, ReactiveActor
from playslot_rl.config import PolicyConfig
from playslot_rl.frames import normalise
from playslot_rl.methods.autoencoder.method import MODEL, NAME, AutoencoderBCConfig
from playslot_rl.modules.policy import LatentPolicy
from playslot_rl.runs import Run
from playslot_rl.world_model import oracle_module


class Autoencoder(nn.Module):
    def __init__(self, config: AutoencoderBCConfig) -> None:
        super().__init__()
        downs, code = (3, *config.channels), config.code_dim
        levels = [nn.Sequential(nn.Conv2d(a, b, 4, 2, 1), nn.ReLU()) for a, b in pairwise(downs)]
        self.encoder = nn.Sequential(*levels, nn.Conv2d(downs[-1], code, 1))
        ups = [
            nn.Sequential(nn.ReLU(), nn.Conv2d(a, 4 * b, 3, padding=1), nn.PixelShuffle(2))
            for a, b in pairwise(downs[::-1])
        ]
        self.decoder = nn.Sequential(nn.Conv2d(code, downs[-1], 1), *ups)

    def forward(self, pixels: Tensor) -> Tensor:
        """Frames (B, 3, H, W), uint8 or float [0, 1], to their reconstructions, float, about [0, 1]."""
        out: Tensor = self.decoder(self.encoder(normalise(pixels)))
        return out


class CodePolicy(nn.Module):
    """Real actions from the code of frames of `image_size`, by an encoder that stays as it is."""

    mean: Tensor
    std: Tensor

    def __init__(
        self, encoder: nn.Module, config: PolicyConfig, own: AutoencoderBCConfig, image_size: int, out_dim: int
    ) -> None:
        super().__init__()
        self.encoder = encoder.requires_grad_(False)
        side = image_size // 2 ** len(own.channels)
        self.position = nn.Parameter(torch.randn(side * side, own.code_dim) * 0.02)
        self.head = LatentPolicy(config, own.code_dim, out_dim, acts=True)
        self.register_buffer("mean", torch.zeros(own.code_dim))
        self.register_buffer("std", torch.ones(own.code_dim))

    @torch.no_grad()
    def code(self, pixels: Tensor) -> Tensor:
        """Frames (B, 3, H, W), uint8 or float [0, 1], to tokens (B, h w, C)."""
        found: Tensor = self.encoder(normalise(pixels)).flatten(2).transpose(1, 2)
        return found

    def standardise(self, pixels: Tensor) -> None:
        """Take the mean and deviation of the code of these frames."""
        tokens = self.code(pixels).flatten(0, 1)
        self.mean.copy_(tokens.mean(0))
        self.std.copy_(tokens.std(0).clamp(min=1e-3))

    def forward(self, pixels: Tensor) -> Tensor:
        """Frames (B, 3, H, W), uint8 or float [0, 1], to actions (B, A), not clamped."""
        actions: Tensor = self.head((self.code(pixels) - self.mean) / self.std + self.position)
        return actions


def load_actor(run: Run, device: torch.device | str = "cpu") -> Actor:
    """The actor of a finished run; a CheckpointError where it is missing, damaged, or of another autoencoder."""
    done = run.stage(NAME, MODEL.name)
    own, (model, env) = done.group(AutoencoderBCConfig, NAME), done.sizes
    policy = done.restore(
        lambda: CodePolicy(Autoencoder(own).encoder, model.policy, own, env.image_size, env.action_dim),
        "policy",
        device,
    )
    return ReactiveActor(oracle_module(policy, keys.PIXELS))
