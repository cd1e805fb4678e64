"""Training by the clock: how many steps a training has is decided anew as they turn out to take longer or shorter.

    steps = done + (seconds - spent - what the last validation takes) / seconds a step, of the latest steps

The learning rate follows: it is that of step `done` of so many, and ends at zero whenever the training does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

TOLERANCE: Final = 0.05
"""A plan that is off by less than this share of the steps to come is left alone."""
LOOKS: Final = 20
"""In how many parts of its steps, or of its seconds, a training looks at the clock."""


@dataclass(frozen=True)
class Pace:
    """The time that a training has.

    Attributes:
        seconds: of wall clock, those of an earlier process that was killed included.
        least: steps that it has in any case.
        settled: steps before which a step is cheaper than later ones (a teacher's): none are added until then.
    """

    seconds: float
    least: int = 1
    settled: int = 0

    def due(self, steps: int, seconds: float, total: int) -> bool:
        """Whether to look at the clock, so many steps and seconds after it was looked at."""
        return steps >= max(1, total // LOOKS) or seconds >= self.seconds / LOOKS

    def steps(self, done: int, spent: float, a_step: float, total: int, last: float = 0.0) -> int:
        """Steps of the whole training, as it looks now: `done` of them took `spent` seconds, one of the latest
        `a_step`; `total` is how it looked before, `last` the seconds of a validation, which comes at the end once more.
        """
        fits = max(done, self.least, done + int((self.seconds - spent - last) / max(a_step, 1e-9)))
        if abs(fits - total) <= TOLERANCE * (total - done) or (fits > total and done <= self.settled):
            return total
        return fits
