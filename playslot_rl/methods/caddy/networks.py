"""CADDY's convolutional networks, and what they are built of.

    Res(o, /k):   LReLU(BN(conv(LReLU(BN(pool_k(conv(x)))))) + BN(pool_k(conv_1x1(x))))
    ConvLSTM:     i, f, o = sigmoid, g = tanh of conv([x, h]);   c' = f c + i g;   h' = o tanh(c')

    E   s_t, m_t = E(x_t):            x 3xHxW in [-1, 1]  ->  s 64xH/8xW/8,  m 1xH/8xW/8 in (0, 1)
    R   y_{t+1} = R(s_t, a_t, v_t):   s, a K, v Z         ->  y 128xH/8xW/8
    G   x^ = G(y):                    y                   ->  x^ 3xH/4xW/4, 3xH/2xW/2, 3xHxW, each in (-1, 1)

E is a stem that halves, then five residual blocks, of which the second and the fourth halve; the last one has a channel
more than the state, the map m before its sigmoid. It is where the agent acts: features of actions are read off s m.

R is ConvLSTM 128; conv 256, halved; ConvLSTM 256; conv 128, doubled; ConvLSTM 128; conv 128. a and v are joined, as
maps that are constant over the frame, to the input of each of the six. BatchNorm follows each of them, LeakyReLU the
convolutions only. What it remembers of earlier frames is in the cells.

G's coarser frames are there for the loss alone; the last one is the prediction.

Shapes: B batch, C channels, H W height and width of a map or frame, h w H/8 and W/8, k pooling factor, K actions, Z
latent dim.

Note: only the first convolution of a residual block pools, and the shortcut is the identity where neither channels nor
resolution change. Convolutions are 3x3 unless said otherwise and have no biases where BatchNorm follows.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from playslot_rl.frames import normalise

SLOPE = 0.2
"""Of every LeakyReLU."""

Memory = tuple[Tensor, Tensor]
"""Hidden state h and cell c of a ConvLSTM, each (B, C, H, W)."""
Memories = tuple[Memory, ...]

Pyramid = tuple[Tensor, Tensor, Tensor]
"""Frames (B, 3, h, w) at a quarter, a half and the full resolution."""

KERNELS = (3, 3, 7)
"""Of the heads, from the coarsest."""


def convolution(in_channels: int, out_channels: int, resample: nn.Module | None = None) -> nn.Sequential:
    """3x3 convolution, resampling if any, BatchNorm, LeakyReLU: (B, in, H, W) to (B, out, H', W')."""
    return nn.Sequential(
        nn.Conv2d(in_channels, out_channels, 3, padding=1, bias=False),
        nn.Identity() if resample is None else resample,
        nn.BatchNorm2d(out_channels),
        nn.LeakyReLU(SLOPE),
    )


def double() -> nn.Upsample:
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


class Encoder(nn.Module):
    """E; `channels` are those of the stem and of the three widths."""

    def __init__(self, channels: tuple[int, ...]) -> None:
        super().__init__()
        stem, first, second, third = channels
        self.network = nn.Sequential(
            convolution(3, stem, nn.AvgPool2d(2)),
            Res(stem, first),
            Res(first, second, 2),
            Res(second, second),
            Res(second, third, 2),
            Res(third, third),
            Res(third, third + 1),
        )

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Frames (B, 3, H, W) in [-1, 1] to states (B, C, H/8, W/8) and maps (B, 1, H/8, W/8) in (0, 1)."""
        out: Tensor = self.network(x)
        return out[:, :-1], out[:, -1:].sigmoid()


def inside(frames: Tensor) -> Tensor:
    """Frames of any shape, uint8 or float [0, 1], to what E reads, in [-1, 1]."""
    return normalise(frames) * 2 - 1


class Dynamics(nn.Module):
    """R, with `condition` = K + Z; the cell at half the state's resolution has twice the channels."""

    def __init__(self, in_channels: int, condition: int, channels: int, side: int) -> None:
        super().__init__()
        wide = 2 * channels
        self.cells = nn.ModuleList(
            (
                ConvLSTM(in_channels + condition, channels, side),
                ConvLSTM(wide + condition, wide, side // 2),
                ConvLSTM(channels + condition, channels, side),
            )
        )
        self.norms = nn.ModuleList(nn.BatchNorm2d(width) for width in (channels, wide, channels))
        self.convs = nn.ModuleList(
            (
                convolution(channels + condition, wide, nn.AvgPool2d(2)),
                convolution(wide + condition, channels, double()),
                convolution(channels + condition, channels),
            )
        )

    def begin(self, batch: int) -> Memories:
        return tuple(cell.begin(batch) for cell in self.cells)  # type: ignore[operator]

    def forward(self, s: Tensor, a: Tensor, v: Tensor, memories: Memories) -> tuple[Tensor, Memories]:
        """One step: states (B, C, h, w), actions (B, K), each a distribution, variabilities (B, Z) and the memories of
        the step before, or `begin`, to y (B, channels, h, w) and the next memories.
        """
        condition = torch.cat((a, v), dim=-1)
        kept = []
        for cell, norm, conv, memory in zip(self.cells, self.norms, self.convs, memories, strict=True):
            hidden, memory_cell = cell(_join(s, condition), memory)
            kept.append((hidden, memory_cell))
            s = conv(_join(norm(hidden), condition))
        return s, tuple(kept)


def _join(x: Tensor, condition: Tensor) -> Tensor:
    maps = condition[:, :, None, None].expand(-1, -1, *x.shape[-2:])
    return torch.cat((x, maps), dim=1)


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
