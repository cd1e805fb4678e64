"""CADDY's recurrent part R: a frame's state and what was done there, to what the next frame is generated from.

    y_{t+1} = R(s_t, a_t, v_t):   s 64xH/8xW/8, a K, v Z   ->   y 128xH/8xW/8

    ConvLSTM 128; conv 256, halved; ConvLSTM 256; conv 128, doubled; ConvLSTM 128; conv 128

a and v are joined, as maps that are constant over the frame, to the input of each of the six. BatchNorm follows each of
the six, LeakyReLU the convolutions only. What it remembers of earlier frames is in the cells.

Shapes: B batch, C channels of s, h w its height and width (H/8, W/8).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from playslot_rl.methods.caddy.blocks import ConvLSTM, Memory, convolution, double

Memories = tuple[Memory, ...]


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
