"""The two models of unlabelled videos, each with an encoder E of single frames, and the policy on its frozen code.

    o^_t = D(E(o_t))                                                     autoencoder
    z_t = IDM(E(o_t), E(o_{t+1})),   o^_{t+1} = o_t + FDM(o_t, z_t)      ResNet-18, by latent inverse dynamics
    a_t = f((E(o_t) - m) / s + P)                                        policy

E gives a map of codes, whose h w places take that of the slots in the policy's network f; m and s are their mean and
deviation on the demonstrations, P is a learned position of each, as the ResNet Oracle has it. The ResNet learns through
z alone, whose few numbers say what changed: no action is read, which videos do not have.

Note: DynaMo predicts the next frame's features, and needs terms against their collapse; pixels cannot collapse.

Shapes: B batch, T frames (1 of the autoencoder, 2 of the other), H W image height and width, h w = H / 2^L, W / 2^L
with L levels, C code width, A action dim.
"""

from __future__ import annotations

from functools import partial
from itertools import pairwise
from typing import ClassVar, Self

import torch
from torch import Tensor, nn

from playslot_rl import keys
from playslot_rl.acting.actor import Actor, ReactiveActor
from playslot_rl.config import PolicyConfig
from playslot_rl.frames import normalise
from playslot_rl.methods.frozen_encoder.method import (
    AUTOENCODER_BC,
    INVERSE_BC,
    AutoencoderBCConfig,
    EncoderBCConfig,
    InverseBCConfig,
)
from playslot_rl.methods.lapo.model import ChangeUNet
from playslot_rl.modules.policy import LatentPolicy
from playslot_rl.runs import Run
from playslot_rl.world_model import oracle_module


class VideoEncoder(nn.Module):
    """A model of unlabelled videos whose `encoder` maps frames (B, 3, H, W), float [0, 1], to codes (B, C, h, w)."""

    frames: ClassVar[int]
    encoder: nn.Module

    def shown(self, pixels: Tensor) -> Tensor:
        """The last of frames (B, T, 3, H, W), float [0, 1], as the model has it (B, 3, H, W), float, about [0, 1]."""
        raise NotImplementedError


class Autoencoder(VideoEncoder):
    frames = 1

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

    def shown(self, pixels: Tensor) -> Tensor:
        out: Tensor = self.decoder(self.encoder(pixels[:, 0]))
        return out


class LatentInverse(VideoEncoder):
    frames = 2

    def __init__(self, config: InverseBCConfig, image_size: int) -> None:
        from torchvision.models import resnet18

        super().__init__()
        self.encoder = nn.Sequential(*list(resnet18(weights=None).children())[:-2])
        width, levels = config.code
        features = 2 * width * (image_size // 2**levels) ** 2
        self.inverse = nn.Sequential(
            nn.Linear(features, config.hidden), nn.ReLU(), nn.Linear(config.hidden, config.latent_dim)
        )
        self.forward_model = ChangeUNet(3, config.channels, config.latent_dim, start=True)

    def shown(self, pixels: Tensor) -> Tensor:
        now, after = pixels.unbind(1)
        codes = self.encoder(torch.cat((now, after))).flatten(1).chunk(2)
        return now + self.forward_model.change(now, self.inverse(torch.cat(codes, dim=-1)))


def video_encoder(own: EncoderBCConfig, image_size: int) -> VideoEncoder:
    """The untrained model that these settings are of."""
    if isinstance(own, InverseBCConfig):
        return LatentInverse(own, image_size)
    assert isinstance(own, AutoencoderBCConfig)
    return Autoencoder(own)


class CodePolicy(nn.Module):
    """Real actions from the code of frames of `image_size`, by an encoder that stays as it is; `code` is its width and
    its levels. Of several `tasks` it is told which, as the `LatentPolicy` that is its head.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        encoder: nn.Module,
        config: PolicyConfig,
        code: tuple[int, int],
        image_size: int,
        out_dim: int,
        tasks: int = 0,
    ) -> None:
        super().__init__()
        self.encoder = encoder.requires_grad_(False)
        width, levels = code
        side, self.tasks = image_size // 2**levels, tasks
        self.position = nn.Parameter(torch.randn(side * side, width) * 0.02)
        self.head = LatentPolicy(config.of_frames, width, out_dim, acts=True, tasks=tasks)
        self.register_buffer("mean", torch.zeros(width))
        self.register_buffer("std", torch.ones(width))

    def train(self, mode: bool = True) -> Self:
        """Of the policy; the encoder's batch statistics stay as they are, too."""
        super().train(mode)
        self.encoder.eval()
        return self

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

    def forward(self, pixels: Tensor, *task: Tensor) -> Tensor:
        """Frames (B, 3, H, W), uint8 or float [0, 1], and the task int64 (B, 1) where it is told, to actions (B, A),
        not clamped.
        """
        actions: Tensor = self.head((self.code(pixels) - self.mean) / self.std + self.position, *task)
        return actions


def _load(name: str, parent: str, kind: type[EncoderBCConfig], run: Run, device: torch.device | str = "cpu") -> Actor:
    """The actor of a finished run; a CheckpointError where it is missing, damaged, or of another model."""
    done = run.stage(name, parent)
    own, (model, env) = done.group(kind, name), done.sizes

    def build() -> CodePolicy:
        encoder = video_encoder(own, env.image_size).encoder
        return CodePolicy(encoder, model.policy, own.code, env.image_size, env.action_dim, len(env.tasks))

    return ReactiveActor(oracle_module(done.restore(build, "policy", device), keys.PIXELS), len(env.tasks))


load_autoencoder = partial(_load, AUTOENCODER_BC.name, "autoencoder", AutoencoderBCConfig)
load_inverse_resnet = partial(_load, INVERSE_BC.name, "inverse_resnet", InverseBCConfig)
