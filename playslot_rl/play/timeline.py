"""The moments of a session as a tree: going back forgets nothing, and every moment can be a fork.

Shapes: N slots of the world model, n of them still there, D slot width, Z latent-action width, A action width,
H W image height and width. "[N,]" is there with one latent action per slot.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
import numpy.typing as npt
from tensordict import TensorDictBase
from torch import Tensor

Frame = npt.NDArray[np.uint8]

MOST: Final = 3000
"""Moments a session keeps: some 50 kB each, more than three minutes at 15 frames a second."""


@dataclass(frozen=True)
class SceneMoment:
    """One moment: what the world model knew, what was seen, and how it came about. Frames are uint8 (H, W, 3).

    Attributes:
        number: its place in the timeline, in the order of making.
        depth: moments before it on its branch.
        state: of the imagination session, batch size [1]; never changed.
        present: numbers (from 0) of the world model's slots that are still there, n of them, in their order.
        latent: ([N,] Z) that led here; None at the start and after a touch.
        code: number of its prototype, int64 () or (N,).
        action: decoded, float32 (A,) in the robot's units; None without a decoder.
        true: what the simulator showed after the same actions.
        recorded: the recorded episode's frame of the same time; None beside a simulator and after the episode's end.
        steps: latent actions that led here; touches take no time.
    """

    number: int
    parent: int | None
    depth: int
    state: TensorDictBase
    present: tuple[int, ...]
    frozen: frozenset[int]
    frame: Frame
    latent: Tensor | None = None
    code: Tensor | None = None
    action: npt.NDArray[np.float32] | None = None
    true: Frame | None = None
    recorded: Frame | None = None
    steps: int = 0
    label: str = "start"

    @cached_property  # drawn again at every step, of all moments
    def error(self) -> float | None:
        """Root mean squared difference of the imagined frame to the true one, of [0, 1]."""
        if self.true is None:
            return None
        difference = self.frame.astype(np.float32) - self.true.astype(np.float32)
        return float(np.sqrt(np.square(difference).mean())) / 255.0


class Timeline:
    """A tree of moments with a place in it."""

    def __init__(self, first: SceneMoment) -> None:
        self.moments = [first]
        self.at = 0
        self._heading = 0  # the present moment is on the way to it

    @property
    def now(self) -> SceneMoment:
        return self.moments[self.at]

    @property
    def full(self) -> bool:
        return len(self.moments) >= MOST

    def add(self, moment: SceneMoment) -> None:
        """Append a child of the present moment and go there; a ValueError where the timeline is full."""
        if self.full:
            raise ValueError(f"timeline: got {MOST} moments, expected no more: record it and start anew")
        assert moment.number == len(self.moments)
        assert moment.parent == self.at
        self.moments.append(moment)
        self.at = self._heading = moment.number

    def back(self) -> bool:
        """Go to the moment before; False at the start."""
        parent = self.now.parent
        if parent is not None:
            self.at = parent
        return parent is not None

    def go(self, number: int) -> None:
        """Go to any moment; a ValueError where there is none of this number."""
        if not 0 <= number < len(self.moments):
            raise ValueError(f"timeline: got moment {number}, expected 0 to {len(self.moments) - 1}")
        if all(moment.number != number for moment in self.path(self._heading)):
            self._heading = number
        self.at = number

    def path(self, number: int | None = None) -> list[SceneMoment]:
        """The moments from the start to one of them, by default the present one, both included."""
        found = [self.moments[self.at if number is None else number]]
        while (parent := found[-1].parent) is not None:
            found.append(self.moments[parent])
        return found[::-1]

    def branch(self) -> list[SceneMoment]:
        """The present branch: the path to the furthest moment visited on it, and on by the newest child of each."""
        newest = {moment.parent: moment for moment in self.moments}
        found = self.path(self._heading)
        while found[-1].number in newest:
            found.append(newest[found[-1].number])
        return found

    def tips(self) -> list[SceneMoment]:
        parents = {moment.parent for moment in self.moments}
        return [moment for moment in self.moments if moment.number not in parents]
