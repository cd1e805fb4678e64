"""GridShapes' clips drawn anew for every batch, so that no two are alike: where shapes are is drawn on the host, a few
numbers a clip, and the pixels on the device that computes.

Shapes: B clips, T frames, O objects, H W image height and width, G size of a shape.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from playslot_rl.config import EnvConfig
from playslot_rl.data.clips import Clips
from playslot_rl.envs.grid_shapes import PALETTE, check_actions, sprites, visited
from playslot_rl.runtime.devices import to_device
from playslot_rl.runtime.shares import own_rows
from playslot_rl.seeds.draws import StepGenerators


class DrawnClips(Clips):
    """Clips whose batches are drawn by the rules of `playslot_rl.envs.grid_shapes.generate`, as a function of seed and
    step; the held-out ones are the data set's.

    Args:
        env: the task; raises as `check_actions`.
        stride: every so many steps there is a frame.
        given: as `Clips`.
    """

    def __init__(self, env: EnvConfig, stride: int, *given: Any) -> None:
        check_actions(env)
        super().__init__(*given)
        self.validated = "held-out"
        self.env, self.stride = env, stride
        self._sprites = padded_sprites(env.grid.size)

    def batch(
        self, stream: str, count: int, generators: StepGenerators, device: torch.device, frames: int | None = None
    ) -> Tensor:
        """As of `Clips`. Raises ConfigError: shapes that cannot move."""
        steps = max(1, self.stride * (self.frames - 1))
        corners, shapes, colours = visited(generators.numpy(stream), count, steps, self.env)
        corners = corners[:, :: self.stride][:, : self.frames][:, :frames]
        at, kind, painted = (
            to_device(own_rows(torch.from_numpy(part)), device) for part in (corners, shapes, PALETTE[colours])
        )
        self._sprites = self._sprites.to(device)
        return paint(at, kind, painted, self._sprites, self.env.image_size)


def padded_sprites(size: int) -> Tensor:
    """The pixels of each shape, bool (3, G + 1, G + 1): the last row and column are outside of it."""
    return F.pad(torch.from_numpy(sprites(size)), (0, 1, 0, 1))


def paint(corners: Tensor, shapes: Tensor, colours: Tensor, table: Tensor, size: int) -> Tensor:
    """Frames uint8 (B, T, 3, H, W) on the device of what they are drawn from.

    Args:
        corners: int64 (B, T, O, 2), x and y of each object's upper left corner, pixels.
        shapes: int64 (B, O), index into `table`, which `padded_sprites` makes.
        colours: uint8 (B, 1 + O, 3), the ground's first.
        size: H and W.
    """
    batch, frames, objects = corners.shape[:3]
    outside = table.shape[-1] - 1
    inside = torch.arange(size, device=corners.device) - corners[..., None]  # (B, T, O, 2, H)
    inside = inside.where((inside >= 0) & (inside < outside), outside)
    painted = colours[:, None, :, :, None, None]
    picture = painted[:, :, 0].expand(batch, frames, 3, size, size)
    for o in range(objects):  # later ones occlude earlier ones
        x, y = inside[:, :, o].unbind(2)
        seen = table[shapes[:, o, None, None, None], y[..., None], x[..., None, :]]
        picture = torch.where(seen[:, :, None], painted[:, :, 1 + o], picture)
    return picture.contiguous()
