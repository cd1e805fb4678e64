"""SVG's convolutions (Denton and Fergus, 2018, appendix): a frame to a code and skip maps, and back.

    h_t, k_t = Enc(x_t),   x^_t = Dec(g_t, k_c)

A level is a group of 3x3 convolutions, each with BatchNorm and LeakyReLU. The encoder halves the resolution after each
level, the decoder doubles it before each and joins the encoder's map of the same resolution. At the bottom are 4x4
pixels, so that G levels belong to frames of 4 * 2^G pixels: 64 for the four of the paper.

Shapes: B frames, H W image height and width, F width of a code, G levels, C_i channels of level i (from 0).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from playslot_rl.config.plain import check

BOTTOM = 4
"""Pixels a side at the lowest resolution."""
SLOPE = 0.2
"""Of LeakyReLU."""


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
        """Frames (B, 3, H, W), float [0, 1], to codes and skip maps.

        Raises:
            ValueError: frames of another size than the levels ask for.
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
    """3x3 convolutions from each width to the next."""
    layers: list[nn.Module] = []
    for before, after in pairwise(widths):
        layers += [nn.Conv2d(before, after, 3, padding=1), nn.BatchNorm2d(after), nn.LeakyReLU(SLOPE, inplace=True)]
    return nn.Sequential(*layers)
