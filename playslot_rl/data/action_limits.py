"""The range of a data set's actions, from its own statistics.

LeRobot's `meta/stats.json` gives the smallest and the largest of each dimension. Where it says nothing that can be used
(missing, NaN, another shape, narrower or far wider than the data) they are computed from the finite values of the data.
Quantiles always are: LeRobot's are means over episodes, which one reading that is none carries off. Our simulators'
actions are in [-1, 1] by definition: their sets have no range of their own.

Shapes: F rows, A action width.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from playslot_rl import keys
from playslot_rl.data.agreement import say_once
from playslot_rl.data.metadata import RECORD_NAME, STATS_NAME, json_content, robot_of

if TYPE_CHECKING:
    from playslot_rl.data.contents import Contents
    from playslot_rl.modules.action_range import ActionRange

WIDE: Final = 3.0
"""Smallest to largest is so many times as wide as q01 to q99 where there may be outliers, and what is stated so many
times as wide as the data where it is not believed."""
UNITS: Final = 20.0
"""Ranges so many times as wide are of another unit: degrees are 57 times as many as radians."""
FEW: Final = 0.001
"""Share of the rows up to which values far outside q01 to q99 are outliers; more are a motion, such as a gripper's."""
HUGE: Final = 1e30  # numbers that no robot knows: with them float32 would overflow

Floats = npt.NDArray[np.float32]


@dataclass(frozen=True)
class ActionLimits:
    """What actions in [-1, 1] stand for in a data set.

    Attributes:
        names: of the dimensions, as the data set names them.
        low, high: float32 (A,), the ends; equal where a dimension never changes.
        smallest, largest: float32 (A,), of the data.
    """

    names: tuple[str, ...]
    low: Floats
    high: Floats
    smallest: Floats
    largest: Floats

    @property
    def quantiles(self) -> npt.NDArray[np.bool_]:
        """bool (A,), where the ends are q01 and q99, because of outliers."""
        return (self.low > self.smallest) | (self.high < self.largest)

    @property
    def span(self) -> Floats:
        """float32 (A,), from end to end."""
        span: Floats = self.high - self.low
        return span

    def give(self, known: ActionRange) -> None:
        import torch

        known.take(torch.from_numpy(self.low), torch.from_numpy(self.high))

    def plain(self) -> dict[str, Any]:
        """Plain values, for checkpoints and policies."""
        outliers = [name for name, cut in zip(self.names, self.quantiles, strict=True) if cut]
        ends = {"low": self.low.tolist(), "high": self.high.tolist()}
        return {"names": list(self.names), **ends, "quantiles": outliers}

    def line(self, actions: Floats) -> str:
        """What was taken, in one line, with the share of these actions (M, A) that lie outside and are clipped."""
        cut = []
        for i in np.flatnonzero(self.quantiles):
            known = actions[~np.isnan(actions[:, i]), i]
            outside = 100 * float(np.mean((known < self.low[i]) | (known > self.high[i])))
            seen = f"{self.smallest[i]:.6g}..{self.largest[i]:.6g}"
            cut.append(f"{self.names[i]} by quantiles (all: {seen}), {outside:.2g} % of its values clipped")
        return "; ".join([f"actions: {said(self.plain())}", *cut])


def said(plain: dict[str, Any] | None) -> str:
    """Names and ends of plain values, for people; of actions that have no range of their own, [-1, 1]."""
    if not plain:
        return "[-1, 1]"
    ends = zip(plain["names"], plain["low"], plain["high"], strict=True)
    return ", ".join(f"{name} {low:.6g}..{high:.6g}" if low < high else f"{name} {low:.6g} (constant)"
                     for name, low, high in ends)  # fmt: skip


def scaled(plain: dict[str, Any] | None) -> bool:
    """Whether plain values say anything else than -1 and 1."""
    return plain is not None and bool(plain) and (set(plain["low"]), set(plain["high"])) != ({-1.0}, {1.0})


def limits_of(files: Contents, actions: Floats | None) -> ActionLimits | None:
    """The range of a data set's actions (F, A); None without any, and for sets of our own simulators."""
    if actions is None or _simulated(files, actions):
        return None
    values = np.where(np.abs(actions) < HUGE, actions, np.nan)
    names, stated = _names(files.features[keys.FEATURE_ACTION], values.shape[1]), _stated(files, values.shape[1])
    first, last, smallest, largest = _ends(values, 0.01)
    if stated is not None and (stated[0] <= smallest).all() and (stated[1] >= largest).all():
        wide = stated[1] - stated[0] > WIDE * (largest - smallest)
        if wide.any():
            say_once(
                f"note: {files.name}: {STATS_NAME} says more than {WIDE:g} times the range that the actions "
                f"{', '.join(np.array(names)[wide])} have: their own is taken"
            )
        smallest, largest = (np.where(wide, own, far) for own, far in zip((smallest, largest), stated, strict=True))
    span = last - first
    far = ((values < first - span) | (values > last + span)).sum(axis=0)
    outlying = (largest - smallest > WIDE * span) & (far > 0) & (far <= max(2, FEW * len(values)))
    low, high = np.where(outlying, first, smallest), np.where(outlying, last, largest)
    return ActionLimits(names, low, high, smallest, largest)


def _simulated(files: Contents, actions: Floats) -> bool:
    """Whether a set is of our own simulators: it is named as they are, and has our record or no value beyond 1."""
    named = ours(robot_of(files.info))
    return named and ((files.root / RECORD_NAME).is_file() or not (np.abs(actions) > 1).any())


def ours(robot: str) -> bool:
    """Whether a set's `robot_type` is one of our own simulators."""
    from playslot_rl.envs import ENVIRONMENTS, PROCEDURAL  # with Gymnasium

    return robot in (*ENVIRONMENTS, *PROCEDURAL)


def other_units(span: Floats, other: Floats) -> bool:
    """Whether the numbers of actions that change, ranges (A,) each, are all `UNITS` times as wide on the same side, as
    degrees are beside radians.
    """
    change = (span > 0) & (other > 0)
    ratio = span[change] / other[change]
    return bool(change.any() and ((ratio > UNITS).all() or (ratio < 1 / UNITS).all()))


def joined_limits(parts: Sequence[ActionLimits | None], width: int) -> ActionLimits | None:
    """The range that covers those of several data sets; one without counts as -1 to 1. None where none has any."""
    known = [part for part in parts if part is not None]
    if not known:
        return None
    one, names = np.ones(width, np.float32), known[0].names
    every = [ActionLimits(names, -one, one, -one, one) if part is None else part for part in parts]
    low, high = np.min([p.low for p in every], axis=0), np.max([p.high for p in every], axis=0)
    smallest, largest = np.min([p.smallest for p in every], axis=0), np.max([p.largest for p in every], axis=0)
    return ActionLimits(names, low, high, smallest, largest)


def _ends(values: Floats, beyond: float) -> Floats:
    """Values between which all but a share at either end lie, and the smallest and largest, (4, A); 0 where none is
    finite."""
    found = np.zeros((4, values.shape[1]), np.float32)
    for i, column in enumerate(values.T):
        known = np.sort(column[~np.isnan(column)])
        if len(known):
            cut = math.ceil(beyond * (len(known) - 1))
            found[:, i] = known[cut], known[-1 - cut], known[0], known[-1]
    return found


def _stated(files: Contents, width: int) -> tuple[Floats, Floats] | None:
    """Smallest and largest by `meta/stats.json`, if they can be used."""
    try:
        stats = json_content(files.root / STATS_NAME)[keys.FEATURE_ACTION]
        with np.errstate(over="ignore"):
            low, high = (np.asarray(stats[name], np.float64).astype(np.float32).reshape(-1) for name in ("min", "max"))
    except (OSError, ValueError, KeyError, TypeError, OverflowError):
        return None
    usable = len(low) == len(high) == width and (np.abs([low, high]) < HUGE).all() and (low <= high).all()
    return (low, high) if usable else None


def _names(feature: dict[str, Any], width: int) -> tuple[str, ...]:
    """Names of the dimensions: a list, or a dict of lists or of numbers; numbered where there are others."""
    given = feature.get("names")
    if isinstance(given, dict):
        values = list(given.values())
        if all(isinstance(value, list) for value in values):
            given = [name for value in values for name in value]
        elif all(isinstance(value, int) for value in values):
            given = sorted(given, key=given.__getitem__)
        else:
            given = list(given)
    if not isinstance(given, list) or len(given) != width or len(set(map(str, given))) != width:
        return tuple(f"action_{i}" for i in range(width))
    plain = ["".join(c if c.isprintable() else " " for c in str(name)) for name in given]
    return tuple(" ".join(name.split())[:64] or f"action_{i}" for i, name in enumerate(plain))
