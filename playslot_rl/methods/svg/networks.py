"""SVG's networks (Denton and Fergus, 2018, section 3 and appendix): a frame to a code and skip maps, what comes next
and what is likely to, and back.

    h_t, k_t = Enc(x_t),   x^_t = Dec(g_t, k_c)
    g_t = LSTM_f([h_{t-1}, z_t]),   q_t = N(mu, sigma^2) = LSTM_q(h_t),   p_t = N(mu, sigma^2) = LSTM_p(h_{t-1})

A level is a group of 3x3 convolutions, each with BatchNorm and LeakyReLU. The encoder halves the resolution after each
level, the decoder doubles it before each and joins the encoder's map of the same resolution. At the bottom are 4x4
pixels, so that G levels belong to frames of 4 * 2^G pixels: 64 for the four of the paper. The LSTMs run in float32,
whatever the convolutions do.

Shapes: B frames or clips, M steps, H W image height and width, F width of a code, Z latent, G levels, C_i channels of
level i (from 0).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from playslot_rl.config.plain import check
from playslot_rl.runtime.shares import own_noise

BOTTOM = 4
"""Pixels a side at the lowest resolution."""
SLOPE = 0.2
"""Of LeakyReLU."""
State = tuple[Tensor, Tensor]
"""Hidden and cell state of an LSTM (layers, B, hidden)."""


class Encoded(NamedTuple):
    """A frame's code h (B, F) in (-1, 1), and its skip maps k, one of each level (B, C_i, H / 2^i, W / 2^i)."""

    code: Tensor
    skips: list[Tensor]

    def rows(self, index: Tensor) -> list[Tensor]:
        """Skip maps of some of the B frames, by int64 numbers (M,): (M, C_i, H / 2^i, W / 2^i)."""
        return [skip[index] for skip in self.skips]


def check_image_size(image_size: int, levels: int) -> None:
    """Refuse a resolution that does not end in 4x4 pixels."""
    fitting = BOTTOM * 2**levels
    check(image_size == fitting, "image_size", image_size, f"{fitting}, for {levels} widths in baselines.svg.channels")


class Encoder(nn.Module):
    """Enc: levels of convolutions with max-pooling between them, then one 4x4 convolution to a vector."""

    def __init__(self, channels: Sequence[int], convs: Sequence[int], features: int) -> None:
        super().__init__()
        ins = (3, *channels[:-1])
        self.levels = nn.ModuleList(
            _group([before, *[width] * count]) for before, width, count in zip(ins, channels, convs, strict=True)
        )
        self.bottom = nn.Sequential(nn.Conv2d(channels[-1], features, BOTTOM), nn.BatchNorm2d(features), nn.Tanh())

    def forward(self, frames: Tensor) -> Encoded:
        """Frames (B, 3, H, W), float [0, 1], to codes and skip maps; a ValueError where the levels ask for another
        size.
        """
        for side in frames.shape[-2:]:
            check_image_size(side, len(self.levels))
        x, skips = frames, []
        for level in self.levels:
            x = level(x)
            skips.append(x)
            x = F.max_pool2d(x, 2)
        return Encoded(self.bottom(x).flatten(1).float(), skips)


class Decoder(nn.Module):
    """Dec: the encoder's mirror image, with twice the channels where a skip map joins.

    The highest level's last convolution is the one to colours, which does not take its only one from it.
    """

    def __init__(self, channels: Sequence[int], convs: Sequence[int], features: int) -> None:
        super().__init__()
        top = nn.ConvTranspose2d(features, channels[-1], BOTTOM)
        self.bottom = nn.Sequential(top, nn.BatchNorm2d(channels[-1]), nn.LeakyReLU(SLOPE, inplace=True))
        levels = []
        for number in reversed(range(len(channels))):
            count = convs[number] if number else max(1, convs[0] - 1)
            inner = [channels[number]] * (count - 1)
            levels.append(_group([2 * channels[number], *inner, channels[max(0, number - 1)]]))
        self.levels = nn.ModuleList(levels)
        self.colours = nn.ConvTranspose2d(channels[0], 3, 3, padding=1)

    def forward(self, code: Tensor, skips: list[Tensor]) -> Tensor:
        """Codes (B, F) and skip maps (B, C_i, H / 2^i, W / 2^i) to frames (B, 3, H, W), float32 in (0, 1)."""
        x = self.bottom(code[:, :, None, None])
        for level, skip in zip(self.levels, reversed(skips), strict=True):
            x = level(torch.cat((F.interpolate(x, scale_factor=2, mode="nearest"), skip), dim=1))
        return torch.sigmoid(self.colours(x).float())


def _group(widths: Sequence[int]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for before, after in pairwise(widths):
        layers += [nn.Conv2d(before, after, 3, padding=1), nn.BatchNorm2d(after), nn.LeakyReLU(SLOPE, inplace=True)]
    return nn.Sequential(*layers)


class Gaussian(NamedTuple):
    """Diagonal Gaussians: mean and log sigma^2, each (..., Z)."""

    mean: Tensor
    log_variance: Tensor

    def sample(self, generator: torch.Generator) -> Tensor:
        """mu + sigma eps (..., Z), differentiable in both; eps is drawn on the generator's device."""
        device, dtype = generator.device, self.mean.dtype
        noise = own_noise(
            self.mean.shape, lambda shape: torch.randn(shape, generator=generator, device=device, dtype=dtype)
        )
        return self.mean + (0.5 * self.log_variance).exp() * noise.to(self.mean.device)


class Recurrent(nn.Module):
    """A linear layer and an LSTM of `layers` cells after it."""

    def __init__(self, in_dim: int, hidden: int, layers: int) -> None:
        super().__init__()
        self.embed = nn.Linear(in_dim, hidden)
        self.lstm = nn.LSTM(hidden, hidden, layers, batch_first=True)

    def forward(self, inputs: Tensor, state: State | None = None) -> tuple[Tensor, State]:
        """Inputs (B, M, in_dim), M at least 1, to outputs (B, M, hidden) and the state after them; None starts at 0."""
        outputs, after = self.lstm(self.embed(inputs), state)
        return outputs, after


class FramePredictor(nn.Module):
    """LSTM_f: the last frame's code and the latent of the change, to the code that is decoded."""

    def __init__(self, features: int, latent_dim: int, hidden: int, layers: int) -> None:
        super().__init__()
        self.recurrent = Recurrent(features + latent_dim, hidden, layers)
        self.to_code = nn.Linear(hidden, features)

    def forward(self, codes: Tensor, latents: Tensor, state: State | None = None) -> tuple[Tensor, State]:
        """h_{t-1} (B, M, F) and z_t (B, M, Z) to g_t (B, M, F) in (-1, 1), and the state after them."""
        with torch.autocast(codes.device.type, enabled=False):
            outputs, after = self.recurrent(torch.cat((codes.float(), latents.float()), dim=-1), state)
            return torch.tanh(self.to_code(outputs)), after


class GaussianLSTM(nn.Module):
    """LSTM_q or LSTM_p: frames' codes to a Gaussian over z after each."""

    def __init__(self, features: int, latent_dim: int, hidden: int) -> None:
        super().__init__()
        self.recurrent = Recurrent(features, hidden, 1)
        self.to_mean = nn.Linear(hidden, latent_dim)
        self.to_log_variance = nn.Linear(hidden, latent_dim)

    def forward(self, codes: Tensor, state: State | None = None) -> tuple[Gaussian, State]:
        """Codes (B, M, F) to Gaussians (B, M, Z), and the state after them."""
        with torch.autocast(codes.device.type, enabled=False):
            outputs, after = self.recurrent(codes.float(), state)
            return Gaussian(self.to_mean(outputs), self.to_log_variance(outputs)), after
