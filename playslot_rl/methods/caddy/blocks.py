"""What CADDY's networks are built of: residual blocks, convolutions that resample, the ConvLSTM.

    Res(o, /k):   LReLU(BN(conv(LReLU(BN(pool_k(conv(x)))))) + BN(pool_k(conv_1x1(x))))
    ConvLSTM:     i, f, o = sigmoid, g = tanh of conv([x, h]);   c' = f c + i g;   h' = o tanh(c')

Shapes: B batch, C channels, H W height and width of a map, k pooling factor.

Note: only the first convolution of a residual block pools, and the shortcut is the identity where neither channels nor
resolution change. Convolutions are 3x3 unless said otherwise and have no biases where BatchNorm follows.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

SLOPE = 0.2
"""Of every LeakyReLU."""

Memory = tuple[Tensor, Tensor]
"""Hidden state h and cell c of a ConvLSTM, each (B, C, H, W)."""


def convolution(in_channels: int, out_channels: int, resample: nn.Module | None = None) -> nn.Sequential:
    """3x3 convolution, resampling if any, BatchNorm, LeakyReLU: (B, in, H, W) to (B, out, H', W')."""
    return nn.Sequential(
        nn.Conv2d(in_channels, out_channels, 3, padding=1, bias=False),
        nn.Identity() if resample is None else resample,
        nn.BatchNorm2d(out_channels),
        nn.LeakyReLU(SLOPE),
    )


def double() -> nn.Upsample:
    """Bilinear upsampling by two."""
    return nn.Upsample(scale_factor=2, mode="bilinear", align_corners=False)


class Res(nn.Module):
    """Residual block that may widen and pool; a factor of 1 keeps the resolution."""

    def __init__(self, in_channels: int, out_channels: int, pool: int = 1) -> None:
        super().__init__()
        self.body = nn.Sequential(
            convolution(in_channels, out_channels, nn.AvgPool2d(pool) if pool > 1 else None),
            nn.Conv2d(out_channels, out_channels, 3, padding=1, bias=False),
            nn.BatchNorm2d(out_channels),
        )
        self.shortcut: nn.Module = nn.Identity()
        if pool > 1 or in_channels != out_channels:
            self.shortcut = nn.Sequential(
                nn.Conv2d(in_channels, out_channels, 1, bias=False),
                nn.AvgPool2d(pool) if pool > 1 else nn.Identity(),
                nn.BatchNorm2d(out_channels),
            )

    def forward(self, x: Tensor) -> Tensor:
        """(B, in, H, W) to (B, out, H / k, W / k)."""
        return F.leaky_relu(self.body(x) + self.shortcut(x), SLOPE)


class ConvLSTM(nn.Module):
    """A convolutional LSTM cell whose memory starts from learned maps of H = W = `side`."""

    def __init__(self, in_channels: int, channels: int, side: int) -> None:
        super().__init__()
        self.gates = nn.Conv2d(in_channels + channels, 4 * channels, 3, padding=1)
        self.first_hidden = nn.Parameter(torch.zeros(channels, side, side))
        self.first_cell = nn.Parameter(torch.zeros(channels, side, side))

    def begin(self, batch: int) -> Memory:
        return self.first_hidden.expand(batch, -1, -1, -1), self.first_cell.expand(batch, -1, -1, -1)

    def forward(self, x: Tensor, memory: Memory) -> Memory:
        """The input (B, in, H, W) and the memory to the next memory."""
        hidden, cell = memory
        i, f, o, g = self.gates(torch.cat((x, hidden), dim=1)).chunk(4, dim=1)
        cell = f.sigmoid() * cell + i.sigmoid() * g.tanh()
        return o.sigmoid() * cell.tanh(), cell
