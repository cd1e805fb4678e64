"""LAPO's inverse and forward model on pixels (Schmidt and Jiang, 2024, "Learning to Act without Actions", section 4).

    z_t = VQ(IDM(o_t, o_{t+1})),   o^_{t+1} = FDM(o_t, z_t)

The forward model sees the next frame only through z_t, whose few codes are the bottleneck: what they best carry is what
the agent did.

Note: LAPO's inverse model also sees o_{t-1}; two frames make the latent comparable with InvDyn's. Each dimension of z
is standardised over the batch (BatchNorm without weights) before it is quantised: pairs of frames differ little from
each other, and otherwise all of them fall to one code, from which nothing is learned. The forward model predicts the
change of the frame and starts from no change at all.

Shapes: B batch, H W image height and width, G groups, Z = G times the width of a code.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from playslot_rl.baselines.lapo.encoder import ConvEncoder, EncoderMLP, ResidualBlock
from playslot_rl.config.baselines import LAPOConfig
from playslot_rl.frames import normalise
from playslot_rl.modules.quantizer import ActionQuantizer


class Inferred(NamedTuple):
    """Latent actions.

    Attributes:
        z: quantised, straight-through (B, Z).
        code: int64 (B, G).
        vq_loss: commitment term, weight included (scalar).
    """

    z: Tensor
    code: Tensor
    vq_loss: Tensor


class InverseModel(nn.Module):
    """IDM: two frames to a quantised latent action.

    Args:
        config: sizes.
        image_size: H = W.
    """

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
        return Inferred(p.flatten(1), code, loss)


class ForwardModel(nn.Module):
    """FDM: a frame and a latent action to the next frame, by a U-Net; the latent enters at its lowest resolution.

    Args:
        config: sizes.
    """

    def __init__(self, config: LAPOConfig) -> None:
        super().__init__()
        channels = config.channels
        self.encoder = ConvEncoder(3, channels)
        self.to_map = nn.Linear(config.latent_dim, channels[-1])
        self.bottom = ResidualBlock(channels[-1])
        outs = (*channels[-2::-1], 3)
        ins = (channels[-1], *(2 * c for c in channels[-2::-1]))
        self.ups = nn.ModuleList(nn.Conv2d(a, 4 * b, 3, padding=1) for a, b in zip(ins, outs, strict=True))
        last = self.ups[-1]
        assert isinstance(last, nn.Conv2d)
        nn.init.zeros_(last.weight)
        assert last.bias is not None
        nn.init.zeros_(last.bias)

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
