"""Which prototypes do the same: measured on what holding each would show, relative to how much they differ at all.

    j ~ k  where  |x_j - x_k| <= max(SHARE * spread, FLOOR),    spread^2 = mean_k |x_k - mean x|^2

|.| is the root mean square over frames and pixels. Against the spread, since what counts as the same is a matter of how
far apart the others are; not below a floor, since prototypes that all do nothing are the same although they have none.

Shapes: K prototypes, P frames, H W image height and width.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
import numpy.typing as npt

SHARE: Final = 0.45
"""Of the spread. Prototypes of the shipped models that nobody can tell apart are up to 0.4 of it apart, others 0.55."""
FLOOR: Final = 0.5
"""Of 255: nobody sees it."""


def alike(frames: npt.NDArray[np.uint8]) -> dict[int, int]:
    """The prototypes that do the same as one of a smaller number, by that number, which is like none before it.

    Args:
        frames: what holding each shows, uint8 (K, P, H, W, 3).
    """
    seen = frames.reshape(len(frames), -1).astype(np.float32)
    spread = float(np.sqrt(np.square(seen - seen.mean(0)).mean()))
    near, found, unlike = max(SHARE * spread, FLOOR), dict[int, int](), list[int]()
    for number, own in enumerate(seen):
        same = [other for other in unlike if float(np.sqrt(np.square(own - seen[other]).mean())) <= near]
        if same:
            found[number] = same[0]
        else:
            unlike.append(number)
    return found


def in_words(found: Mapping[int, int]) -> str:
    """What `alike` found as a line for the page; empty where all differ."""
    groups: dict[int, list[str]] = {}
    for number, other in found.items():
        groups.setdefault(other, []).append(str(number))
    said = []
    for other, numbers in groups.items():
        listed = numbers[0] if len(numbers) == 1 else f"{', '.join(numbers[:-1])} and {numbers[-1]}"
        said.append(f"{listed} {'does' if len(numbers) == 1 else 'do'} the same as {other}")
    return f"from here, {'; '.join(said)}" if said else ""
