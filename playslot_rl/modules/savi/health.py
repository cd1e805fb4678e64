"""Are the slots any good? Numbers on masks and reconstructions of clips, that need no labels.

    entropy   -sum_n m_n log m_n in nats, mean over the pixels: 0 where each has one slot, log N where all share it
    in use    slots that hold at least `LEAST_SHARE` of a clip's pixels
    flicker   exchanges of slots a transition: N less the cycles of the matching of the masks at t with those at t + 1
    explained 1 - sum (do^ - do)^2 / sum do^2 over the pixels that move, with do = o_{t+1} - o_t and do^ of o^

Shapes: B clips, T frames, N slots, H W image size. A slot holds the pixels where its mask is the largest.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

LEAST_SHARE: Final = 0.005
"""Of a frame's pixels, averaged over a clip, that a slot in use holds: 20 pixels of 64x64, half of a small cube."""
MOVING: Final = 0.1
"""Change of a pixel, the largest of its channels in [0, 1], from which on it moves; camera noise stays below it."""


def owners(masks: Tensor) -> Tensor:
    """Which slot holds each pixel: masks (..., N, 1, H, W) to int64 (..., H, W)."""
    planes = masks.squeeze(-3).unbind(-3)
    owner, most = torch.zeros_like(planes[0], dtype=torch.long), planes[0]
    # Plane by plane: an argmax over an inner axis takes ten times as long on a CPU.
    for n, plane in enumerate(planes[1:], 1):
        owner = torch.where(plane > most, n, owner)
        most = torch.maximum(most, plane)
    return owner


def held_share(labels: Tensor, n_slots: int) -> Tensor:
    """Share of the pixels that each slot holds: int64 (B, T, H, W) to (B, N)."""
    flat = labels.flatten(1)
    return _counts(flat, n_slots).float() / flat.shape[1]


def _counts(flat: Tensor, values: int) -> Tensor:
    """How often each value from 0 to `values` - 1 stands in each row: int64 (M, P) to int64 (M, values)."""
    rows = len(flat)
    offset = torch.arange(rows, device=flat.device)[:, None] * values
    return torch.bincount((flat + offset).flatten(), minlength=rows * values).view(rows, values)


def mask_entropy(masks: Tensor) -> Tensor:
    """Entropy over the slots, in nats, mean over the pixels: masks (B, ..., N, 1, H, W) to (B,)."""
    entropy: Tensor = torch.special.entr(masks).sum(-4)
    return entropy.flatten(1).mean(1)


def exchanges(labels: Tensor, n_slots: int) -> Tensor:
    """Slots that changed places between consecutive frames.

    The masks of two frames are matched by their overlap (intersection over union). Where nothing speaks for an
    exchange, as with slots that hold nothing, there is none.

    Args:
        labels: int64 (B, T, H, W).
        n_slots: N.

    Returns:
        (B, T - 1) float: 0 where every slot kept its place, 1 for two that changed places, at most N - 1.
    """
    from scipy.optimize import linear_sum_assignment

    pairs = (labels[:, :-1] * n_slots + labels[:, 1:]).flatten(0, 1).flatten(1)
    both = _counts(pairs, n_slots**2).view(*labels[:, 1:].shape[:2], n_slots, n_slots)
    either = both.sum(-1, keepdim=True) + both.sum(-2, keepdim=True) - both
    gain = (both.double() / either.clamp(min=1)).cpu().numpy() + 1e-6 * np.eye(n_slots)
    counts = [
        n_slots - _cycles(linear_sum_assignment(one, maximize=True)[1]) for one in gain.reshape(-1, *gain.shape[-2:])
    ]
    return torch.tensor(counts, dtype=torch.float32).reshape(gain.shape[:2])


def _cycles(permutation: npt.NDArray[np.int64]) -> int:
    """Cycles of a permutation; a fixed point is one."""
    seen, count = set[int](), 0
    for start in range(len(permutation)):
        count += start not in seen
        while start not in seen:
            seen.add(start)
            start = int(permutation[start])
    return count


class SlotHealth:
    """Gathers the numbers over batches of clips.

    Examples:
        >>> masks = torch.eye(2)[:, :, None, None, None].expand(2, 2, 1, 4, 4)[None]  # one slot, then the other
        >>> health = SlotHealth(2)
        >>> health.add(torch.zeros(1, 2, 3, 4, 4), torch.zeros(1, 2, 3, 4, 4), masks)
        >>> health.values()
        {'slots_in_use': 2.0, 'largest_slot': 0.5, 'flicker': 1.0, 'mask_entropy': 0.0}
    """

    def __init__(self, n_slots: int) -> None:
        self.n_slots = n_slots
        self._clips: list[tuple[float, float, float, float]] = []
        self._error = self._motion = 0.0

    def add(self, frames: Tensor, reconstructed: Tensor, masks: Tensor) -> None:
        """Some more clips: frames and reconstructions (B, T, 3, H, W) in [0, 1], masks (B, T, N, 1, H, W)."""
        labels = owners(masks)
        share, swaps = held_share(labels, self.n_slots), exchanges(labels, self.n_slots)
        in_use = (share >= LEAST_SHARE).sum(1)
        # A clip of one frame has no transition, and changes nothing of the mean.
        flicker = swaps.mean(1) if swaps.shape[1] else torch.full((len(labels),), math.nan)
        columns = (in_use, share.amax(1), flicker, mask_entropy(masks))
        self._clips += zip(*(column.float().tolist() for column in columns), strict=True)
        error, motion = change_errors(frames, reconstructed)
        self._error, self._motion = self._error + error, self._motion + motion

    def join(self, other: SlotHealth) -> None:
        """Some more clips, gathered elsewhere."""
        self._clips += other._clips
        self._error, self._motion = self._error + other._error, self._motion + other._motion

    def values(self) -> dict[str, float]:
        """Means over the clips: `slots_in_use` (0 to N), `largest_slot` (share of the pixels of the slot that holds the
        most), `flicker` (exchanges a transition), `mask_entropy` (nats), `moving_explained` (at most 1; it may be far
        below 0). What cannot be told, of clips of one frame or in which nothing moves, is left out.
        """
        names = ("slots_in_use", "largest_slot", "flicker", "mask_entropy")
        columns = dict(zip(names, np.array(self._clips, np.float64).reshape(-1, len(names)).T, strict=True))
        found = {name: float(np.mean(known)) for name, c in columns.items() if len(known := c[~np.isnan(c)])}
        return found | ({"moving_explained": 1.0 - self._error / self._motion} if self._motion else {})


def moves(change: Tensor) -> Tensor:
    """Which pixels move: changes from frame to frame (B, T-1, 3, H, W) of [0, 1] to booleans (B, T-1, 1, H, W)."""
    return change.abs().amax(2, keepdim=True) >= MOVING


def change_errors(frames: Tensor, reconstructed: Tensor) -> tuple[float, float]:
    """Sums over the pixels that move, of clips (B, T, 3, H, W): squared error of the change, and squared change."""
    real, drawn = frames[:, 1:] - frames[:, :-1], reconstructed[:, 1:] - reconstructed[:, :-1]
    where = moves(real).float()
    return float(((drawn - real).square() * where).sum()), float((real.square() * where).sum())
