"""CADDY's generator G: what the recurrent part predicts, to frames at a quarter, a half and the full resolution.

    y 128xH/8xW/8   ->   x^ 3xH/4xW/4,  3xH/2xW/2,  3xHxW,  each in (-1, 1)

The coarser frames are there for the loss alone; the last one is the prediction.
"""

from __future__ import annotations

from torch import Tensor, nn

from playslot_rl.methods.caddy.blocks import Res, convolution, double

Pyramid = tuple[Tensor, Tensor, Tensor]
"""Frames (B, 3, h, w) at a quarter, a half and the full resolution."""

KERNELS = (3, 3, 7)
"""Of the heads, from the coarsest."""


class Generator(nn.Module):
    """G; `channels` are those at a quarter, a half and the full resolution."""

    def __init__(self, in_channels: int, channels: tuple[int, ...]) -> None:
        super().__init__()
        quarter, half, full = channels
        self.levels = nn.ModuleList(
            (
                nn.Sequential(double(), convolution(in_channels, quarter), Res(quarter, quarter)),
                nn.Sequential(double(), convolution(quarter, half), Res(half, half)),
                nn.Sequential(double(), convolution(half, full)),
            )
        )
        self.heads = nn.ModuleList(
            nn.Conv2d(width, 3, kernel, padding=kernel // 2) for width, kernel in zip(channels, KERNELS, strict=True)
        )

    def forward(self, y: Tensor) -> Pyramid:
        """(B, C, H/8, W/8) to frames at three resolutions, float32."""
        frames = []
        for level, head in zip(self.levels, self.heads, strict=True):
            y = level(y)
            frames.append(head(y).float().tanh())
        return frames[0], frames[1], frames[2]
