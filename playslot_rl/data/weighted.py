"""Several data sets as one, each drawn from as often as its weight says: first the set, then a window of it.

    P(window w of set i) = weight_i / sum_j weight_j  *  1 / (windows of set i)

Without weights every window of all sets is equally likely, so that a set counts by its size.

Shapes: P sets, E episodes, F frames, B batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from playslot_rl.data.rows import IntArray
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.views import concatenate, text_hash
from playslot_rl.errors import DataError


@dataclass(frozen=True)
class Shares:
    """Which rows belong to which set. An episode's set follows from its first row, however episodes are chosen.

    Attributes:
        ends: int64 (P,), the row after each set's last one.
        weights: float64 (P,), above 0; they need not add up to 1.
        sources: the sets; empty where they are not whole any more.
        fingerprint: of all of them while they are whole: who has another one has only some of their episodes.
    """

    ends: IntArray
    weights: npt.NDArray[np.float64]
    sources: tuple[EpisodeFrames, ...]
    fingerprint: str

    def of(self, starts: IntArray) -> IntArray:
        """The set of each episode, (E,), from the episodes' first rows."""
        found: IntArray = np.searchsorted(self.ends, starts, side="right").astype(np.int64)
        return found

    def between(self, begin: int, end: int) -> Shares:
        """Of rows `begin` to `end` (exclusive), counted anew."""
        return replace(self, ends=np.clip(self.ends, begin, end) - begin, sources=())


def weighted(sources: Sequence[EpisodeFrames], weights: Sequence[float | None], names: Sequence[str]) -> EpisodeFrames:
    """Several data sets as one. Nothing is copied: each keeps its own frame cache.

    Args:
        weights: of each; all None draws every window of all sets alike, as `concatenate`.

    Raises:
        DataError: sets with weights differ in frame size, rate or width of their actions.
    """
    given = [weight for weight in weights if weight is not None]
    if len(sources) == 1:
        return sources[0]
    if not given:
        return concatenate(sources)
    for source, name in zip(sources[1:], names[1:], strict=True):
        for what, got, want in _facts(source, sources[0]):
            if got != want:
                raise DataError(f"{name}: got {what} {got}, expected {want} as in {names[0]}: read sets of one kind")
    joined = concatenate(sources)
    fingerprint = text_hash(f"{joined.fingerprint}/weights {','.join(f'{weight:g}' for weight in given)}")
    ends = np.cumsum([len(source.frames) for source in sources]).astype(np.int64)
    shares = Shares(ends, np.asarray(given, np.float64), tuple(sources), fingerprint)
    return replace(joined, fingerprint=fingerprint, shares=shares)


def _facts(source: EpisodeFrames, other: EpisodeFrames) -> list[tuple[str, object, object]]:
    facts: list[tuple[str, object, object]] = [
        ("frames of", _size(source), _size(other)),
        ("frames a second", f"{source.fps:g}", f"{other.fps:g}"),
    ]
    if source.robot and other.robot:
        facts.append(("recordings of", source.robot, other.robot))
    if source.actions is not None and other.actions is not None:
        facts.append(("actions of width", source.actions.shape[1], other.actions.shape[1]))
    return facts


def _size(source: EpisodeFrames) -> str:
    return "x".join(map(str, source.image_size))


def draw_episodes(
    shares: Shares, starts: IntArray, places: IntArray, batch: int, generator: np.random.Generator
) -> tuple[IntArray, IntArray]:
    """Draw a set by its weight, then one of the places in its episodes.

    Returns:
        Episode and place in it, int64 (B,) each.

    Raises:
        DataError: a set has no place at all.
    """
    groups = shares.of(starts)
    counts = np.bincount(groups, weights=places, minlength=len(shares.ends)).astype(np.int64)
    if (counts == 0).any():
        number = int(np.flatnonzero(counts == 0)[0])
        raise DataError(
            f"data.root: got no window in set {number + 1} of {len(counts)}, expected at least one in each set with a "
            "weight: leave that set out, shorten the training window or hold out fewer episodes"
        )
    drawn = generator.choice(len(counts), size=batch, p=shares.weights / shares.weights.sum())
    within = generator.integers(0, counts[drawn])
    order = np.argsort(groups, kind="stable")  # the episodes of one set after the other
    cumulative = np.cumsum(places[order])
    wanted = within + (np.cumsum(counts) - counts)[drawn]
    position = np.searchsorted(cumulative, wanted, side="right")
    offset = wanted - (cumulative[position] - places[order][position])
    return order[position].astype(np.int64), offset.astype(np.int64)
