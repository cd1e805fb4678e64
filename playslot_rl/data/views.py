"""Data sets as views of others: several as one, some of their episodes, every k-th frame, all frames moved.

    view[i] = moved(joined[rows_i]),   joined: the parts, one after the other

Nothing is copied or computed before it is read; the fingerprint of each follows from what it is a view of.

Shapes: F rows (frames), E episodes, A action width, H W image height and width, C channels.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
import numpy.typing as npt

from playslot_rl.data.action_limits import joined_limits, other_units, said
from playslot_rl.data.agreement import say_once
from playslot_rl.data.turns import turns
from playslot_rl.errors import DataError

if TYPE_CHECKING:
    from playslot_rl.data.source import EpisodeFrames

Frames = npt.NDArray[np.uint8]
IntArray = npt.NDArray[np.int64]

DIRECTIONS = ((1, 1), (-1, -1), (1, -1), (-1, 1), (1, 0), (-1, 0), (0, 1), (0, -1))
"""Of shifted copies, (down, right): corners first, so that the first four surround the original."""
DRAW_STREAM = 14  # keeps the draws of demonstrations apart from what else a seed draws
TEST_STREAM = 0x7E57  # seed of the split in training and test episodes


class FrameRows(Protocol):
    """Rows (F, ...), uint8 (F, H, W, 3) of frames; an array, or something that reads like one."""

    @property
    def shape(self) -> tuple[int, ...]: ...

    @property
    def dtype(self) -> Any: ...

    def __len__(self) -> int: ...

    def __getitem__(self, rows: Any, /) -> Any:
        """Rows by an integer, a slice or an integer array of any shape."""


def row_numbers(rows: Any, count: int) -> tuple[IntArray, tuple[int, ...]]:
    """The rows that an index means, int64 (n,) from 0 on, and its shape: an integer, a slice or an integer array of any
    shape, in which negative numbers count from the end. An IndexError where there is no such row."""
    if isinstance(rows, slice):
        rows = np.arange(*rows.indices(count))
    index = np.asarray(rows, np.int64)
    flat = np.where(index < 0, index + count, index).reshape(-1)
    if flat.size and (flat.min() < 0 or flat.max() >= count):
        raise IndexError(f"row {int(flat.max())}: expected 0 to {count - 1}")
    return flat, index.shape


def shift_frames(frames: Frames, offsets: npt.ArrayLike) -> Frames:
    """Frames (..., H, W, C) moved by pixels (down, right), by offsets (2,) or each by its own (..., 2); edges repeat.

    Example:
        >>> frames = np.arange(4, dtype=np.uint8).reshape(1, 2, 2, 1)
        >>> shift_frames(frames, [[0, 1]])[0, ..., 0].tolist()
        [[0, 0], [2, 2]]
    """
    height, width = frames.shape[-3:-1]
    flat = frames.reshape(-1, *frames.shape[-3:])
    moves = np.broadcast_to(np.asarray(offsets).reshape(-1, 2), (len(flat), 2))
    down = (np.arange(height) - moves[:, :1]).clip(0, height - 1)
    right = (np.arange(width) - moves[:, 1:]).clip(0, width - 1)
    moved: Frames = flat[np.arange(len(flat))[:, None, None], down[:, :, None], right[:, None, :]]
    return moved.reshape(frames.shape)


@dataclass(frozen=True, eq=False)
class RowView:
    """Rows of other rows: several in a row as one, some of them, or all of them moved.

    Attributes:
        parts: one after the other along the first axis.
        rows: int64 (F,), which rows of the parts; None takes all.
        offset: pixels (down, right) that every frame is moved by.

    Example:
        >>> frames = np.arange(8, dtype=np.uint8).reshape(2, 2, 2, 1)
        >>> RowView((frames, frames), rows=np.array([3]), offset=(0, 1))[0, ..., 0].tolist()
        [[4, 4], [6, 6]]
    """

    parts: Sequence[FrameRows]
    rows: IntArray | None = None
    offset: tuple[int, int] = (0, 0)

    @cached_property
    def shape(self) -> tuple[int, ...]:
        """(F, ...)."""
        return (int(self._ends[-1]) if self.rows is None else len(self.rows), *self.parts[0].shape[1:])

    @property
    def dtype(self) -> Any:
        return self.parts[0].dtype

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: Any) -> Any:
        """Rows by an integer, a slice or an integer array of any shape."""
        if len(self.parts) == 1:
            found = np.asarray(self.parts[0][rows if self.rows is None else self.rows[rows]])
        else:
            flat, shape = row_numbers(rows, len(self))
            found = np.empty((len(flat), *self.shape[1:]), self.dtype)
            for part, here, own in self.located(flat):
                if len(own):
                    found[here] = part[own]
            found = found.reshape(*shape, *self.shape[1:])
        return shift_frames(found, self.offset) if any(self.offset) else found

    def located(self, rows: IntArray) -> Iterator[tuple[FrameRows, npt.NDArray[np.bool_], IntArray]]:
        """Each part, which of the rows (n,), numbers from 0 on, are in it, bool (n,), and their numbers there."""
        rows = rows if self.rows is None else self.rows[rows]
        number = np.searchsorted(self._ends, rows, side="right")
        for i, part in enumerate(self.parts):
            here = number == i
            yield part, here, rows[here] - (int(self._ends[i]) - len(part))

    @cached_property
    def _ends(self) -> IntArray:
        """The row after each part's last one."""
        return np.cumsum([len(part) for part in self.parts])


def text_hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _viewed(source: EpisodeFrames, how: str, **changes: Any) -> EpisodeFrames:
    return replace(source, fingerprint=text_hash(f"{source.fingerprint}/{how}"), **changes)


def chosen_episodes(source: EpisodeFrames, numbers: IntArray, how: str) -> EpisodeFrames:
    """Some recorded episodes, in an order: with all their views, which keep theirs. Row numbers stay, so that the slot
    cache of the whole serves any choice."""
    episodes, recorded = numbers, None
    if source.recorded is not None:
        place = np.full(source.recordings, -1)
        place[numbers] = np.arange(len(numbers))
        episodes = np.flatnonzero(place[source.recorded] >= 0)
        recorded = place[source.recorded[episodes]]
    known = {name: getattr(source, name) for name in ("starts", "lengths", "seeds", "tasks", "origins")}
    chosen = {name: None if values is None else values[episodes] for name, values in known.items()}
    return _viewed(source, how, **chosen, recorded=recorded)


def by_turns(source: EpisodeFrames) -> EpisodeFrames:
    """The same episodes, whose tasks take turns from now on."""
    if not (tasks := recorded_tasks(source)) or source.shares is not None:  # who clones refuses weights
        return source
    order, taking = turns(tasks), replace(source, turns=True)
    if (np.diff(order) > 0).all():
        return taking
    chosen = chosen_episodes(taking, order, "by turns")
    rows = np.concatenate([chosen.episode_rows(episode) for episode in range(chosen.episodes)])
    return replace(_counted_anew(source, chosen, rows), starts=np.cumsum(chosen.lengths) - chosen.lengths)


def recorded_tasks(source: EpisodeFrames) -> list[str]:
    """What is to be done in each recorded episode (R); empty where it was not read."""
    return [] if source.tasks is None else [str(task) for task in source.tasks[source.first_views]]


def views_of_one(views: Sequence[EpisodeFrames]) -> EpisodeFrames:
    """One data set as several cameras saw it: each episode once for each of them."""
    if len(views) == 1:
        return views[0]
    joined, recorded = concatenate(views), np.tile(np.arange(views[0].episodes), len(views))
    return _viewed(joined, "views", recorded=recorded)


def agree(sources: Sequence[EpisodeFrames], weights: bool = False) -> None:
    """Refuse, by a DataError, one set twice, sets of other frame sizes or rates, or with the same actions in another
    order, with `weights` of other robots or widths of actions, too; what else is not as in the first is said."""
    first = sources[0]
    met = {(first.fingerprint, first.camera)}
    for number, source in enumerate(sources[1:], 1):
        size, expected = ("x".join(map(str, each.image_size)) for each in (source, first))
        facts: list[tuple[str, object, object, str]] = [
            ("frames of", size, expected, ""),
            ("frames a second", f"{source.fps:g}", f"{first.fps:g}", ""),
        ]
        if source.robot and first.robot:
            facts.append(("recordings of", source.robot, first.robot, "leave one out, unless they act alike"))
        if source.actions is not None and first.actions is not None:
            widths = source.actions.shape[1], first.actions.shape[1]
            facts.append(("actions of width", *widths, "none are read; leave one out where they count"))
        names, others = (() if each.limits is None else each.limits.names for each in (source, first))
        if sorted(names) == sorted(others):
            facts.append(("actions in the order", ", ".join(names), ", ".join(others), ""))
        for what, got, want, cure in facts:
            unlike = f"{source.name}: got {what} {got}, expected {want} as in {first.name}"
            if got != want and (weights or not cure):
                raise DataError(f"{unlike}: read sets of one kind")
            if got != want:
                say_once(f"note: {unlike}: {cure}")
        _say_units(source, sources[:number])
        if (source.fingerprint, source.camera) in met:
            raise DataError(
                f"{source.name}: got the frames of {source.camera} twice, expected each recording once: leave one out "
                "of data.root= or data.camera="
            )
        met.add((source.fingerprint, source.camera))
        if source.name != first.name and source.camera != first.camera:
            seen = f"{source.name}: got frames of {source.camera}, expected {first.camera} as in {first.name}"
            say_once(f"note: {seen}: choose by data.camera=, unless they show the same view")
    for camera in dict.fromkeys(source.camera for source in sources):
        say_shared([(source.name, source.origins) for source in sources if source.camera == camera])


def _say_units(source: EpisodeFrames, earlier: Sequence[EpisodeFrames]) -> None:
    """Say where a set's actions are far wider or narrower than those of the first earlier one of the same robot."""
    for other in earlier:
        robots = {source.robot, other.robot} - {""}
        if source.limits is None or other.limits is None or len(robots) > 1:
            continue
        if sorted(source.limits.names) == sorted(other.limits.names):
            if other_units(source.limits.span, other.limits.span):
                own, there = (said(each.plain()) for each in (source.limits, other.limits))
                say_once(f"note: {source.name}: got {own}, in {other.name} {there}: are the units the same?")
            return


def say_shared(sets: Sequence[tuple[str, npt.NDArray[np.str_] | None]]) -> None:
    """Say which data sets, by their names and their episodes' `origins`, have episodes of an earlier one."""
    for (other, others), (name, own) in itertools.combinations(sets, 2):
        if own is not None and others is not None and (count := int(np.isin(own, others).sum())):
            say_once(f"note: {name}: {count} of its {len(own)} episodes have actions of {other}'s, and count twice")


def concatenate(sources: Sequence[EpisodeFrames], weights: bool = False) -> EpisodeFrames:
    """Several data sets as one; labels that not all have, or of another width, are dropped, but actions that only some
    have are NaN in the others. Raises as `agree`."""
    if len(sources) == 1:
        return sources[0]
    agree(sources, weights)
    offsets = np.cumsum([0, *(len(source.frames) for source in sources)])[:-1]
    before = np.cumsum([0, *(source.recordings for source in sources)])
    recorded = [source.numbers + count for source, count in zip(sources, before, strict=False)]

    def joined(name: str) -> Any:
        labels = [getattr(source, name) for source in sources]
        if any(label is None or label.shape[1:] != labels[0].shape[1:] for label in labels):
            return None
        return np.concatenate(labels)

    acting, actions = [source for source in sources if source.actions is not None], None
    silent = {s.name if s.actions is None else s.unlabelled: None for s in sources if acting}
    if len(widths := {source.require_actions().shape[1] for source in acting}) == 1:
        none = np.full((1, *widths), np.nan, np.float32)
        rows = [none.repeat(len(s.frames), axis=0) if s.actions is None else s.actions for s in sources]
        actions = np.concatenate(rows)
    return replace(
        sources[0],
        camera=",".join(dict.fromkeys(source.camera for source in sources)),
        frames=RowView([source.frames for source in sources]),
        starts=np.concatenate([s.starts + offset for s, offset in zip(sources, offsets, strict=True)]),
        lengths=joined("lengths"),
        actions=actions,
        states=joined("states"),
        seeds=joined("seeds"),
        tasks=joined("tasks"),
        origins=joined("origins"),
        recorded=None if all(s.recorded is None for s in sources) else np.concatenate(recorded),
        fingerprint=text_hash("+".join(source.fingerprint for source in sources)),
        name=",".join(dict.fromkeys(source.name for source in sources)),
        shares=None,
        unlabelled=",".join(filter(None, silent)),
        limits=None if actions is None else joined_limits([s.limits for s in acting], actions.shape[1]),
    )


def shifted(source: EpisodeFrames, offset: tuple[int, int]) -> EpisodeFrames:
    """Every frame moved by `offset` pixels (down, right), edges repeated; labels and row numbers stay.

    SAVi reads videos, so a copy keeps one offset from its first frame to its last.
    """
    return _viewed(source, f"shifted {offset[0]} {offset[1]}", frames=RowView([source.frames], offset=offset))


def shifted_copies(source: EpisodeFrames, shift: int, copies: int) -> Sequence[EpisodeFrames]:
    """The first `copies` of the eight neighbours at `shift` pixels; none where `shift` is 0."""
    return [shifted(source, (shift * y, shift * x)) for y, x in DIRECTIONS[: copies if shift else 0]]


def every(source: EpisodeFrames, stride: int, action: Literal["mean", "last"] = "mean") -> EpisodeFrames:
    """The same episodes with every `stride`-th of their frames; `stride` 1 gives the data set itself.

        row r of episode e  <-  row starts_e + k r,    r = 0 .. ceil(lengths_e / k) - 1

    The action of a kept row is the mean of the k actions that lead to the next kept one (those of a velocity or of a
    displacement a step stay in their range), or the `last` of them (of targets: where the robot is to be then).
    """
    if stride < 1:
        raise ValueError(f"stride: got {stride}, expected 1 (every frame) or more")
    if stride == 1:
        return source
    lengths = -(-source.lengths // stride)
    pairs = zip(source.starts, source.lengths, strict=True)
    rows = np.concatenate([np.arange(s, s + n, stride, dtype=np.int64) for s, n in pairs])
    return _viewed(
        source,
        f"every {stride}" + ("" if action == "mean" else f" {action}"),
        frames=RowView([source.frames], rows),
        starts=(np.cumsum(lengths) - lengths).astype(np.int64),
        lengths=lengths.astype(np.int64),
        actions=None if source.actions is None else _led_actions(source, stride, action == "last"),
        states=None if source.states is None else source.states[rows],
        fps=source.fps / stride,
    )


def _led_actions(source: EpisodeFrames, stride: int, only_last: bool) -> npt.NDArray[np.float32]:
    """(F, A) for the kept rows. An episode's last action is padding and counts only where nothing else is left."""
    actions, found = source.require_actions(), []
    for start, length in zip(source.starts, source.lengths, strict=True):
        for first in range(0, int(length), stride):
            last = max(first + 1, min(first + stride, int(length) - 1))
            led = actions[start + first : start + last]
            found.append(led[-1] if only_last else led.mean(axis=0))
    return np.stack(found).astype(np.float32)


def episode_range(source: EpisodeFrames, first: int, last: int) -> EpisodeFrames:
    """Recorded episodes `first` to `last` (exclusive) as a data set of their own, rows counted anew."""
    chosen = chosen_episodes(source, np.arange(first, last), f"episodes {first} {last}")
    rows = np.arange(chosen.starts[0], chosen.starts[-1] + chosen.lengths[-1])
    if source.recorded is not None:  # what lies between is of other episodes
        rows = np.concatenate([chosen.episode_rows(episode) for episode in range(chosen.episodes)])
    return replace(_counted_anew(source, chosen, rows), starts=np.searchsorted(rows, chosen.starts).astype(np.int64))


def _counted_anew(source: EpisodeFrames, chosen: EpisodeFrames, rows: IntArray) -> EpisodeFrames:
    """Episodes of a data set with some of its rows alone; where they start is theirs to say."""
    # A slice of a memory map is a view, but of others it would be copied to memory, all of it.
    sliced = slice(rows[0], rows[-1] + 1) if (np.diff(rows) == 1).all() else rows
    frames = source.frames
    whole = {name: getattr(source, name) for name in ("actions", "states")}
    labels: dict[str, Any] = {name: None if values is None else values[sliced] for name, values in whole.items()}
    return replace(
        chosen,
        frames=frames[sliced] if isinstance(frames, np.ndarray) and sliced is not rows else RowView([frames], rows),
        shares=None if source.shares is None else source.shares.among(rows),
        **labels,
    )


def first_demonstrations(source: EpisodeFrames, demos: int | None) -> EpisodeFrames:
    """The first `demos` recorded episodes (a DataError where there are fewer); None, or all, gives the set itself."""
    if demos is None or demos == source.recordings:
        return source
    if demos > source.recordings:
        raise DataError(
            f"demos: got {demos}, expected at most the {source.recordings} demonstrations there are: "
            "lower it or collect more"
        )
    return chosen_episodes(source, np.arange(demos), f"first {demos}")


def drawn_demonstrations(source: EpisodeFrames, seed: int, among: int | None = None) -> EpisodeFrames:
    """The same episodes, the first `among` of them (None: all) in an order drawn by a seed; tasks that take turns still
    do."""
    first = first_demonstrations(source, among)
    order = np.random.default_rng([seed, DRAW_STREAM]).permutation(first.recordings)
    how = f"drawn {seed}"
    if first.turns:
        tasks = recorded_tasks(first)
        order, how = order[turns([tasks[episode] for episode in order])], f"{how} by turns"
    drawn = chosen_episodes(source, np.concatenate((order, np.arange(first.recordings, source.recordings))), how)
    return replace(drawn, fingerprint=text_hash(f"{first.fingerprint}/{how}"))


def acting_first(source: EpisodeFrames, among: int | None = None) -> EpisodeFrames:
    """The same episodes, of the first `among` of them (None: all) those with actions before those without."""
    order = np.argsort(source.silent[source.first_views][:among], kind="stable")
    if (order[1:] > order[:-1]).all():
        return source
    return chosen_episodes(source, np.concatenate((order, np.arange(len(order), source.recordings))), "acting first")


def split_tested(source: EpisodeFrames, fraction: float) -> tuple[EpisodeFrames, EpisodeFrames]:
    """The episodes that are trained on, and a fraction, two at least, that is kept for a test, the same for every seed.

    Raises:
        DataError: fewer than two would be left for either.
    """
    trained, tested = tested_numbers(source.recordings, fraction)
    return (
        chosen_episodes(source, trained, f"trained {len(tested)}"),
        chosen_episodes(source, tested, f"tested {len(tested)}"),
    )


def tested_numbers(episodes: int, fraction: float) -> tuple[IntArray, IntArray]:
    """Numbers of these episodes, sorted; raises as `split_tested`."""
    kept = max(2, round(fraction * episodes))
    if episodes - kept < 2:
        raise DataError(
            f"data.tested={fraction}: got {episodes} episodes, expected at least 4, two of them to train on: "
            "collect more"
        )
    order = np.random.default_rng(TEST_STREAM).permutation(episodes)
    return np.sort(order[kept:]), np.sort(order[:kept])
