"""Which numbers seed the episodes: one stream for each use, and no number is in two of them.

    number(stream, s, i) = first(stream) + 10^6 s + i                       for the few hundred smallest s
                         = stream's bits + 2^20 s + i,  at least 2^59       for all others

A seed s that people type is any non-negative 32-bit number. The small ones keep the numbers that they have always had,
all below 2^45, so that data sets and results stay what they are; the larger ones have their stream in the highest bits.
An episode that starts solved is drawn anew with another number, a `redraw_stride` further on, in its stream too.
"""

from __future__ import annotations

from typing import Final, Literal, get_args

Stream = Literal["collection", "evaluation", "training", "development"]
"""Recorded data; measured success; what a method that acts learns from; the points of its learning curve."""

LARGEST_SEED: Final = 2**32 - 1
LARGEST_DRAW: Final = 2**63 - 1  # of seeds that only shuffle what is there
EPISODES: Final = 1_000_000  # episodes of one seed in one stream

TEST_BLOCKS: Final = 2**31
"""From here on a seed of the evaluation stream is a test's block of episodes, drawn once, when all is frozen; below are
development's blocks, which choices are made on."""

_SMALL: Final[dict[Stream, tuple[int, int]]] = {
    "collection": (0, 1_000_000_000),
    "evaluation": (1_000_000_000, 3_000_000_000),
    "training": (3_000_000_000, 4_000_000_000),
    "development": (4_000_000_000, 5_000_000_000),
}
"""First number of seed 0, and the end of the stream's small seeds."""
EVALUATION: Final = _SMALL["evaluation"][0]
_MARGIN: Final = {"evaluation": 100 * EPISODES}
"""Left free at the end: evaluation redraws by the number of its episodes, twenty times at most."""

_SMALL_STRIDE: Final = 10**12
_STREAM_BIT, _DRAW_BIT, _SEED_BIT = 59, 54, 20


def episode_seed(stream: Stream, seed: int, index: int, first: int | None = None) -> int:
    """Number that seeds an episode: below 2^62, so that it fits into an int64.

    Args:
        stream: what it is for.
        seed: of the run or the collection, 0 to 2^34 - 1 (beyond 32 bits, for what is derived from a typed one).
        index: of the episode, 0 to 10^6 - 1; the numbers of a seed follow one another.
        first: of evaluation's small seeds instead of 10^9. With a smaller one they may be a collection's.

    Raises:
        ValueError: seed or index outside its range.

    Examples:
        >>> episode_seed("collection", 3, 7), episode_seed("evaluation", 0, 0)
        (3000007, 1000000000)
        >>> episode_seed("collection", 4242, 7) >> 59, episode_seed("evaluation", 4242, 7) >> 59
        (1, 2)
    """
    if not 0 <= seed < 2 ** (_DRAW_BIT - _SEED_BIT):
        raise ValueError(f"seed: got {seed}, expected 0 to {LARGEST_SEED}")
    if not 0 <= index < EPISODES:
        raise ValueError(f"episode: got {index}, expected 0 to {EPISODES - 1}")
    begin, end = _SMALL[stream]
    small = (begin if first is None else first) + seed * EPISODES
    if small + EPISODES + _MARGIN.get(stream, 0) <= end:
        return small + index
    bits = 1 + get_args(Stream).index(stream)
    return (bits << _STREAM_BIT) + (seed << _SEED_BIT) + index


def redraw_stride(number: int, turns: int = 1) -> int:
    """Distance between an episode's number and those drawn next where it starts solved, 31 at most; the task or goal
    stays that of the number where these are taken in turn, so many of them.
    """
    return whole_turns(1 << _DRAW_BIT if number >> _STREAM_BIT else _SMALL_STRIDE, turns)


def whole_turns(stride: int, turns: int) -> int:
    """The least multiple of the turns from a stride on."""
    return stride + -stride % turns
