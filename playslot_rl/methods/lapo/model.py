"""LAPO's inverse and forward model on pixels (Schmidt and Jiang, 2024, "Learning to Act without Actions", section 4),
and the convolutional encoder that its three networks share in form (not in weights).

    z_t = VQ(IDM(o_t, o_{t+1})),   o^_{t+1} = FDM(o_t, z_t)

The forward model sees the next frame only through z_t, whose few codes are the bottleneck: what they best carry is what
the agent did.

Note: LAPO's inverse model also sees o_{t-1}; two frames make the latent comparable with InvDyn's. Each dimension of z
is standardised over the batch (BatchNorm without weights) before it is quantised: pairs of frames differ little from
each other, and otherwise all of them fall to one code, from which nothing is learned. The forward model predicts the
change of the frame and starts from no change at all.

Shapes: B batch, C input channels, H W image height and width, G groups, Z = G times the width of a code.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from playslot_rl.acting.actor import Actor, latent_actor
from playslot_rl.frames import normalise
from playslot_rl.methods.decoded_policy import DecodedPolicy
from playslot_rl.methods.lapo.method import MODEL, NAME, LAPOConfig
from playslot_rl.modules.quantizer import ActionQuantizer
from playslot_rl.runs import Run


class ResidualBlock(nn.Module):
    """x + conv(relu(conv(relu(x)))), 3x3, same channels."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels, channels, 3, padding=1)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = x + self.second(F.relu(self.first(F.relu(x))))
        return out


class ConvEncoder(nn.Module):
    """Levels of halved resolution: a strided 3x3 conv and a residual block (after IMPALA, Espeholt et al., 2018)."""

    def __init__(self, in_channels: int, channels: tuple[int, ...]) -> None:
        super().__init__()
        ins = (in_channels, *channels[:-1])
        self.levels = nn.ModuleList(
            nn.Sequential(nn.Conv2d(a, b, 3, stride=2, padding=1), ResidualBlock(b))
            for a, b in zip(ins, channels, strict=True)
        )

    def forward(self, x: Tensor) -> list[Tensor]:
        """(B, C, H, W) to the outputs of all levels, (B, channels[i], H / 2^(i+1), W / 2^(i+1)), after a ReLU."""
        outputs = []
        for level in self.levels:
            x = F.relu(level(x))
            outputs.append(x)
        return outputs


class EncoderMLP(nn.Module):
    """A ConvEncoder's last level, flattened, through one hidden layer: (B, C, H, W) to (B, out_dim)."""

    def __init__(self, in_channels: int, channels: tuple[int, ...], image_size: int, hidden: int, out_dim: int) -> None:
        super().__init__()
        self.encoder = ConvEncoder(in_channels, channels)
        side = image_size // 2 ** len(channels)
        self.mlp = nn.Sequential(nn.Linear(channels[-1] * side * side, hidden), nn.ReLU(), nn.Linear(hidden, out_dim))

    def forward(self, x: Tensor) -> Tensor:
        return self.out(self.hidden(x))

    def hidden(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to the hidden layer, (B, hidden), after its ReLU."""
        h: Tensor = self.mlp[:2](self.encoder(x)[-1].flatten(1))
        return h

    def out(self, hidden: Tensor) -> Tensor:
        """(B, hidden) to (B, out_dim)."""
        out: Tensor = self.mlp[2](hidden)
        return out


class Inferred(NamedTuple):
    """Latent actions z, quantised straight-through, and as they were `before` (B, Z), their codes int64 (B, G), and the
    commitment term, weight included (scalar).
    """

    z: Tensor
    before: Tensor
    code: Tensor
    vq_loss: Tensor


class InverseModel(nn.Module):
    """IDM: two frames to a quantised latent action."""

    def __init__(self, config: LAPOConfig, image_size: int) -> None:
        super().__init__()
        self.config = config
        self.network = EncoderMLP(6, config.channels, image_size, config.hidden, config.latent_dim)
        self.standardise = nn.BatchNorm1d(config.latent_dim, affine=False)
        self.quantizer = ActionQuantizer(
            config.code_dim, config.codes, config.decay, config.dead_threshold, config.commitment
        )

    def forward(self, first: Tensor, second: Tensor) -> Inferred:
        """Frames (B, 3, H, W), uint8 or float [0, 1], to latent actions; the codebook moves in training mode."""
        z = self.network(torch.cat((normalise(first), normalise(second)), dim=1)).float()
        grouped = self.standardise(z).view(-1, self.config.groups, self.config.code_dim)
        p, code, loss = self.quantizer(grouped)
        return Inferred(p.flatten(1), grouped.flatten(1), code, loss)


class ForwardModel(nn.Module):
    """FDM: a frame and a latent action to the next frame, by a U-Net; the latent enters at its lowest resolution."""

    def __init__(self, config: LAPOConfig) -> None:
        super().__init__()
        channels = config.channels
        self.encoder = ConvEncoder(3, channels)
        self.to_map = nn.Linear(config.latent_dim, channels[-1])
        self.bottom = ResidualBlock(channels[-1])
        outs = (*channels[-2::-1], 3)
        ins = (channels[-1], *(2 * c for c in channels[-2::-1]))
        self.ups = nn.ModuleList(nn.Conv2d(a, 4 * b, 3, padding=1) for a, b in zip(ins, outs, strict=True))
        for parameter in self.ups[-1].parameters():
            nn.init.zeros_(parameter)

    def forward(self, frame: Tensor, z: Tensor) -> Tensor:
        """Frames (B, 3, H, W), uint8 or float [0, 1], and latents (B, Z) to next frames, float, about [0, 1]."""
        frame = normalise(frame)
        *skips, x = self.encoder(frame)
        x = self.bottom(x + self.to_map(z)[:, :, None, None])
        for i, up in enumerate(self.ups):
            x = F.pixel_shuffle(up(F.relu(x)), 2)
            if i < len(skips):
                x = torch.cat((x, skips[-1 - i]), dim=1)
        predicted: Tensor = frame + x
        return predicted


class LAPOPolicy(nn.Module):
    """LAPO's latent policy: frames (B, 3, H, W), uint8 or float [0, 1], to latent actions (B, Z)."""

    def __init__(self, config: LAPOConfig, image_size: int) -> None:
        super().__init__()
        self.network = EncoderMLP(3, config.channels, image_size, config.hidden, config.latent_dim)

    def forward(self, pixels: Tensor) -> Tensor:
        return self.decide(self.features(pixels))

    def features(self, observed: Tensor) -> Tensor:
        """Frames to the hidden layer, as one slot (B, 1, hidden)."""
        return self.network.hidden(normalise(observed))[:, None]

    def decide(self, features: Tensor) -> Tensor:
        return self.network.out(features[:, 0])


def load_actor(run: Run, device: torch.device | str = "cpu") -> Actor:
    """The actor of a finished run; a CheckpointError where it is missing, damaged, or of another inverse model."""
    done = run.stage(NAME, MODEL.name)
    own, size = done.group(LAPOConfig, NAME), done.sizes[1].image_size
    parts = DecodedPolicy.load(done, lambda: LAPOPolicy(own, size), own.latent_dim, own.hidden, device)
    return latent_actor(parts.policy, parts.action_decoder)
