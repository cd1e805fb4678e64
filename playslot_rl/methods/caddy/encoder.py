"""CADDY's encoder E: a frame to its state and to where in it the agent acts.

    s_t, m_t = E(x_t):   x 3xHxW in [-1, 1]   ->   s 64xH/8xW/8,   m 1xH/8xW/8 in (0, 1)

A stem that halves, then five residual blocks, of which the second and the fourth halve; the last one has a channel more
than the state, the map m before its sigmoid. Features of actions are read off s m.
"""

from __future__ import annotations

from torch import Tensor, nn

from playslot_rl.frames import normalise
from playslot_rl.methods.caddy.blocks import Res, convolution


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
