"""What latent actions do when they are replayed: elsewhere, held, or exchanged for others.

Effects are displacements of the slots: of the centroid of the pixels that a slot holds, in pixels, over L imagined
steps from one parsed frame.

Shapes: W windows, L steps, K prototypes, S places, N slots, D slot width, H W image size. A latent is ([N,] Z).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from playslot_rl.frames import to_uint8
from playslot_rl.modules.savi.health import LEAST_SHARE, owners
from playslot_rl.world_model import WorldModel

Floats = npt.NDArray[np.float64]
AT_ONCE = 32
"""Frames decoded at a time: bounds the memory."""
MOVES = 1.0
"""Pixels over L steps, from which on a slot counts as moving."""
TURNOVER = 0.2
"""Share of the pixels held before or after L steps that are held only once, from which on a slot counts as moving."""


@dataclass(frozen=True)
class Drawn:
    """Decoded slots: frames uint8 (M, H, W, 3) and which slot holds each pixel, int64 (M, H, W)."""

    frames: npt.NDArray[np.uint8]
    labels: npt.NDArray[np.int64]


@torch.no_grad()
def draw(model: WorldModel, slots: Tensor) -> Drawn:
    """Decode slots (M, N, D)."""
    frames, labels = [], []
    for some in slots.split(AT_ONCE):
        decoded = model.savi.decode(some)
        frames.append(to_uint8(decoded.frames))
        labels.append(owners(decoded.masks).cpu().numpy())
    return Drawn(np.concatenate(frames), np.concatenate(labels))


@torch.no_grad()
def replay(model: WorldModel, start: Tensor, latents: Tensor) -> Tensor:
    """Slots (M, L, N, D) imagined from slots (M, N, D) under latents (M, L, [N,] Z)."""
    return model.predictor.rollout(start[:, None], *model.inverse_dynamics.split(latents))


def centroids(labels: npt.NDArray[np.int64], n_slots: int) -> tuple[Floats, Floats]:
    """Centroids (M, N, 2) as x, y in pixels, NaN for a slot that holds nothing, and shares (M, N) of the pixels."""
    h, w = labels.shape[1:]
    held = np.eye(n_slots)[labels.reshape(len(labels), -1)]
    y, x = np.divmod(np.arange(h * w), w)
    count = held.sum(1)
    with np.errstate(invalid="ignore", divide="ignore"):
        where = np.stack([np.einsum("mpn,p->mn", held, axis.astype(float)) / count for axis in (x, y)], -1)
    return where, count / (h * w)


def displacements(before: npt.NDArray[np.int64], after: npt.NDArray[np.int64], n_slots: int) -> Floats:
    """How far each slot moved, (M, N, 2) in pixels; 0 for one that holds less than `LEAST_SHARE` of either frame."""
    (a, held_a), (b, held_b) = centroids(before, n_slots), centroids(after, n_slots)
    seen = (held_a >= LEAST_SHARE) & (held_b >= LEAST_SHARE)
    moved: Floats = np.where(seen[..., None], np.nan_to_num(b - a), 0.0)
    return moved


def agreement(one: Floats, other: Floats) -> float | None:
    """Correlation of displacements (W, N, 2), each slot's and axis's mean taken off; None if nothing varies.

    All slots count by how far they move, so that a still background does not.
    """
    a, b = one - one.mean(0), other - other.mean(0)
    size = float(np.sqrt((a**2).sum() * (b**2).sum()))
    return float((a * b).sum()) / size if size > 1e-9 else None


def same_mover(one: Floats, other: Floats) -> float | None:
    """Share of the windows in which the same slot moves most in both (W, N, 2), of those in which one moves by `MOVES`
    pixels in `one`; None if none does.
    """
    a, b = np.linalg.norm(one, axis=-1), np.linalg.norm(other, axis=-1)
    moving = a.max(1) >= MOVES
    if not moving.any():
        return None
    return float(((a.argmax(1) == b.argmax(1)) & (b.max(1) > 0))[moving].mean())


def explained_by_group(effects: Floats) -> float | None:
    """Share of the variance of effects (K, S, ...) that lies between the K groups, adjusted for their number.

    1 - (within / (K S - K)) / (total / (K S - 1)): 1 where a group has one effect, about 0 where groups say nothing (it
    may be below); None where nothing varies, or there is one group or place.
    """
    k, s = effects.shape[:2]
    flat = effects.reshape(k, s, -1)
    within = float(((flat - flat.mean(1, keepdims=True)) ** 2).sum())
    total = float(((flat - flat.mean((0, 1))) ** 2).sum())
    if k < 2 or s < 2 or total < 1e-9:
        return None
    return 1.0 - (within / (k * s - k)) / (total / (k * s - 1))


@dataclass(frozen=True)
class Region:
    """Where pictures changed.

    Attributes:
        share: of the squared change, inside the region.
        area: of the pixels, inside the region.
    """

    share: float
    area: float

    @property
    def excess(self) -> float:
        """0 where the change is spread over the picture evenly, 1 where all of it is inside; may be below 0."""
        return (self.share - self.area) / (1.0 - self.area) if self.area < 1 else 0.0


def change_in(change: Floats, inside: npt.NDArray[np.bool_]) -> Region | None:
    """How much of squared changes (W, H, W) is inside a region of the same shape; None if nothing changes."""
    total = float(change.sum())
    return Region(float(change[inside].sum()) / total, float(inside.mean())) if total > 0 else None


def squared_change(one: npt.NDArray[np.uint8], other: npt.NDArray[np.uint8]) -> Floats:
    """Squared difference of pictures (W, H, W, 3) in [0, 1], mean over the colours: (W, H, W)."""
    difference = (one.astype(np.float64) - other) / 255.0
    changed: Floats = (difference**2).mean(-1)
    return changed


def moving_slots(before: npt.NDArray[np.int64], after: npt.NDArray[np.int64], n_slots: int) -> npt.NDArray[np.int64]:
    """Slots that move from some frames to others (W, H, W): by `MOVES` pixels in the root mean square, and
    so that `TURNOVER` of what they hold is elsewhere. What an arm only uncovers, a ground, is not among them.
    """
    moved = displacements(before, after, n_slots)
    far = np.sqrt((moved**2).sum(-1).mean(0)) >= MOVES
    slots = np.arange(n_slots)[:, None]
    held, then = (labels.reshape(1, -1) == slots for labels in (before, after))
    either = (held | then).sum(1)
    turnover = 1.0 - (held & then).sum(1) / np.maximum(either, 1)
    return np.flatnonzero(far & (turnover >= TURNOVER)).astype(np.int64)
