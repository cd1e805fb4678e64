"""Whether a data set is what it says it is: counts, indices, timestamps, frames, statistics; and its fingerprint."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from playslot_rl.data.contents import (
    PLACE,
    RECORD_NAME,
    REQUIRED,
    STATS_NAME,
    Array,
    Contents,
    Episode,
    Span,
    Stats,
    is_depth,
    read_contents,
)
from playslot_rl.data.problems import Problems
from playslot_rl.datasets.fingerprint import fingerprint_of
from playslot_rl.datasets.frames import CameraScan, scan_frames
from playslot_rl.datasets.rows import check_rows
from playslot_rl.datasets.statistics import aggregate, differing, has_statistics, of_numbers, rounded
from playslot_rl.errors import DataError

LOOSE_CAMERA = 0.05
"""Tolerance, of [0, 1], for statistics of frames that were compressed with loss or sampled in another way."""


@dataclass(frozen=True)
class Verification:
    """Result of `verify`.

    Attributes:
        root: the data set.
        ok: nothing is wrong.
        errors, warnings: one line each.
        episodes, frames: that are there.
        fingerprint: of the content (see `fingerprint.py`); empty where it cannot be read.
    """

    root: str
    ok: bool
    errors: tuple[str, ...]
    warnings: tuple[str, ...]
    episodes: int
    frames: int
    fingerprint: str

    def to_json(self) -> str:
        """One JSON object."""
        return json.dumps(asdict(self), indent=2)

    def lines(self) -> list[str]:
        """For people."""
        found = [f"error: {line}" for line in self.errors] + [f"warning: {line}" for line in self.warnings]
        counts = f"{self.episodes} episodes, {self.frames} frames"
        if not self.ok:
            return [*found, f"{self.root}: damaged ({len(self.errors)} errors), {counts} can be read"]
        return [*found, f"{self.root}: sound, {counts}, fingerprint {self.fingerprint}"]


def verify(root: str | Path, *, statistics: bool = True) -> Verification:
    """Check everything; reads all rows and decodes all frames (about 2,700 PNG frames of 64x64 a CPU second).

    Never raises for what is wrong with the data set: that is what the result says.

    Args:
        root: its folder.
        statistics: also compare statistics and our own record; others' may be made in another way.
    """
    problems = Problems()
    try:
        contents = read_contents(root, problems)
    except DataError as error:
        return Verification(str(root), False, (str(error),), (), 0, 0, "")
    check_rows(contents, problems)
    scans = scan_frames(contents, problems)
    if statistics:
        check_statistics(contents, scans, problems)
        _check_record(contents, problems)
    errors = tuple(problems.errors)
    fingerprint = fingerprint_of(contents, scans).value if not errors else ""
    return Verification(
        str(root), not errors, errors, tuple(problems.warnings), len(contents.spans), contents.rows, fingerprint
    )


def require_verified(root: Path, sources: Sequence[Path]) -> Verification:
    """Verify a data set that has just been written.

    Raises:
        DataError: it is not sound; then a source was damaged in its frames or statistics.
    """
    result = verify(root)
    if not result.ok:
        names = " ".join(map(str, sources))
        reason = result.errors[0].replace(f"{root}/", "")
        raise DataError(
            f"{names}: the data set made from it is not sound ({reason}), expected sound episodes; nothing was "
            "written: run `playslot dataset verify` and `playslot dataset repair` on it first"
        )
    return result


def require_sound(root: str | Path) -> Contents:
    """Read a data set whose rows and metadata agree; frames and statistics are not looked at.

    Raises:
        DataError: they do not.
    """
    problems = Problems()
    contents = read_contents(root, problems)
    check_rows(contents, problems)
    if problems.errors:
        raise DataError(
            f"{root}: {problems.errors[0]}; got {len(problems.errors)} such faults, expected none: "
            "run `playslot dataset repair` on it first"
        )
    return contents


def check_statistics(contents: Contents, scans: Mapping[str, CameraScan], problems: Problems) -> None:
    """Recompute the statistics of every episode and of all, and compare."""
    by_index = {episode.index: episode for episode in contents.episodes}
    actual, theirs = (
        [episode_statistics(contents, scans, number, as_lerobot=rounds) for number in range(len(contents.spans))]
        for rounds in (False, True)
    )
    for span, exact, rounded_ones in zip(contents.spans, actual, theirs, strict=True):
        episode = by_index.get(span.index)
        if episode is not None and episode.length == span.length:
            _check_episode(contents, episode, exact, rounded_ones, problems)
    _check_all(contents, actual, theirs, problems)


def episode_statistics(
    contents: Contents, scans: Mapping[str, CameraScan], number: int, *, as_lerobot: bool = False
) -> Stats:
    """Statistics of the episode of span `number`; cameras whose frames cannot be decoded are left out.

    Args:
        contents: the data set.
        scans: its frames.
        number: of the span.
        as_lerobot: means and standard deviations with LeRobot's rounding, not exact.
    """
    span: Span = contents.spans[number]
    stats: Stats = {}
    for name, feature in contents.features.items():
        if name in scans:
            camera = (scans[name].theirs if as_lerobot else scans[name].stats)[number]
            if camera is not None:
                stats[name] = camera
        elif has_statistics(feature) and name in contents.columns:
            values = contents.columns[name][span.start : span.stop]
            if values.dtype.kind in "fiub":
                stats[name] = of_numbers(values)
                if as_lerobot:
                    stats[name] |= rounded([values.reshape(len(values), -1) if values.ndim == 1 else values])
    return stats


def _looseness(contents: Contents, name: str, stored: dict[str, Array], actual: dict[str, Array]) -> float:
    """Frames in videos have lost something since; frames in images may have been sampled in another way."""
    if contents.features[name]["dtype"] == "video":
        return LOOSE_CAMERA
    other = contents.features[name]["dtype"] == "image" and "count" in stored
    return LOOSE_CAMERA if other and not np.array_equal(stored["count"].reshape(-1), actual["count"]) else 0.0


def _check_episode(contents: Contents, episode: Episode, actual: Stats, theirs: Stats, problems: Problems) -> None:
    for name, computed in actual.items():
        stored = episode.stats.get(name)
        if stored is None:
            problems.warning("no statistics", f"episode {episode.index}: got no statistics of {name} in meta/episodes")
            continue
        wrong = differing(stored, computed, theirs[name], _looseness(contents, name, stored, computed))
        if wrong:
            _report(problems, name, f"episode {episode.index}: got {', '.join(wrong)} of {name}")


def _check_all(contents: Contents, actual: list[Stats], theirs: list[Stats], problems: Problems) -> None:
    path = contents.root / STATS_NAME
    stored = read_statistics(path, problems)
    if stored is None or not actual:
        return
    total, their_total = aggregate(actual), aggregate(theirs)
    for name, feature in contents.features.items():
        if name not in total or is_depth(feature):
            continue
        if name not in stored:
            problems.error("wrong statistics", f"{path}: got no statistics of {name}, expected those of every feature")
            continue
        loose = _looseness(contents, name, stored[name], total[name])
        wrong = differing(stored[name], total[name], their_total[name], loose)
        if wrong:
            _report(problems, name, f"{path}: got {', '.join(wrong)} of {name}")


def _report(problems: Problems, name: str, what: str) -> None:
    message = f"{what} that the frames and rows do not give, expected their statistics"
    if name in REQUIRED:
        of = "rows' places" if name in PLACE else "time"
        problems.warning("statistics of places", f"{message} (of the {of} only: LeRobot's own merge leaves them stale)")
    else:
        problems.error("wrong statistics", message)


def read_statistics(path: Path, problems: Problems) -> Stats | None:
    """`meta/stats.json`, or None (noted) where it is missing or damaged."""
    try:
        stored: dict[str, dict[str, Any]] = json.loads(path.read_text())
        return {
            name: {key: np.asarray(value, np.float64) for key, value in stats.items()} for name, stats in stored.items()
        }
    except (OSError, ValueError, AttributeError, TypeError) as error:
        reason = "no such file" if isinstance(error, FileNotFoundError) else f"{error!r}"
        problems.error("wrong statistics", f"{path}: got {reason}, expected the statistics of all frames")
        return None


def _check_record(contents: Contents, problems: Problems) -> None:
    """Our own record of the episodes' seeds and outcomes, where there is one."""
    path = contents.root / RECORD_NAME
    if not path.is_file():
        return
    try:
        episodes = json.loads(path.read_text())["episodes"]
        seeds = [entry.get("seed") for entry in episodes]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        problems.error("record", f"{path}: got {error!r}, expected our record of the episodes")
        return
    if len(seeds) != len(contents.spans):
        problems.error("record", f"{path}: got {len(seeds)} episodes, but the rows hold {len(contents.spans)}")
        return
    stored = contents.columns.get("seed")
    if stored is not None and stored.ndim == 1:
        for span, seed in zip(contents.spans, seeds, strict=True):
            if seed is not None and int(stored[span.start]) != seed:
                problems.error(
                    "record", f"{path}: got seed {seed} of episode {span.index}, expected {stored[span.start]}"
                )
