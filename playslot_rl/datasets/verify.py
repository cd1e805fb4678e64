"""Whether a data set is what it says it is: counts, indices, timestamps, frames, statistics; and its fingerprint."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from playslot_rl.data.agreement import check_rows
from playslot_rl.data.contents import Contents, Span, read_contents
from playslot_rl.data.metadata import PLACE, RECORD_NAME, REQUIRED, STATS_NAME, damaged, is_depth, json_content
from playslot_rl.data.places import Problems, inside, parquet_files
from playslot_rl.data.tables import Array, Stats, stored_episodes
from playslot_rl.datasets.fingerprint import CameraScan, fingerprint_of, scan_frames
from playslot_rl.datasets.statistics import Aggregate, differing, of_numbers, reduced, rounded, rows_of
from playslot_rl.errors import DataError

LOOSE_CAMERA = 0.05
"""Tolerance, of [0, 1], for statistics of frames that were compressed with loss or sampled in another way."""


@dataclass(frozen=True)
class Verification:
    """Result of `verify`; `fingerprint` is of the content (`fingerprint.py`), empty where it cannot be read."""

    root: str
    ok: bool
    errors: tuple[str, ...]
    warnings: tuple[str, ...]
    episodes: int
    frames: int
    fingerprint: str

    def to_json(self) -> str:
        return json.dumps(asdict(self), indent=2)

    def lines(self) -> list[str]:
        found = [f"error: {line}" for line in self.errors] + [f"warning: {line}" for line in self.warnings]
        counts = f"{self.episodes} episodes, {self.frames} frames"
        if not self.ok:
            return [*found, f"{self.root}: damaged ({len(self.errors)} errors), {counts} in its rows"]
        return [*found, f"{self.root}: sound, {counts}, fingerprint {self.fingerprint}"]


def verify(root: str | Path, *, statistics: bool = True) -> Verification:
    """Check everything; reads all rows and decodes all frames (about 2,700 PNG frames of 64x64 a CPU second).

    Never raises for what is wrong with the data set: that is what the result says. Without `statistics` those and our
    own record are not compared, others' may be made in another way, and values that are NaN are warnings.
    """
    problems = Problems()
    try:
        contents = read_contents(root, problems, statistics=False)
    except DataError as error:
        return Verification(str(root), False, (str(error),), (), 0, 0, "")
    check_rows(contents, problems)
    scans = scan_frames(contents, problems)
    if statistics:
        check_statistics(contents, scans, problems)
        _check_record(contents, problems)
    else:
        problems.excuse("not finite")
    errors = tuple(problems.errors)
    fingerprint = fingerprint_of(contents, scans).value if not errors else ""
    return Verification(
        str(root), not errors, errors, tuple(problems.warnings), len(contents.spans), contents.rows, fingerprint
    )


def require_verified(root: Path, sources: Sequence[Path]) -> Verification:
    """Verify a data set that has just been written; a DataError says which sources were damaged."""
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
    """Read a data set whose rows and metadata agree, else a DataError; frames and statistics are not looked at."""
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
    numbers = {span.index: number for number, span in enumerate(contents.spans)}
    total, their_total, left = Aggregate(), Aggregate(), set(range(len(contents.spans)))

    def recomputed(number: int) -> tuple[Stats, Stats]:
        left.discard(number)
        exact, theirs = (episode_statistics(contents, scans, number, as_lerobot=rounds) for rounds in (False, True))
        total.add(exact)
        their_total.add(theirs)
        return exact, theirs

    # One episode after the other, as they are stored: those of all at once are some 40 KB each.
    for episode in stored_episodes(parquet_files(contents.root, "meta/episodes"), problems):
        number = numbers.get(episode.index)
        if number not in left:
            continue
        exact, theirs = recomputed(number)
        if episode.length != contents.spans[number].length:
            continue
        where = f"episode {episode.index}"
        for name in exact:
            if name in episode.stats:
                _compare(contents, where, name, episode.stats[name], exact[name], theirs[name], problems)
            else:
                problems.warning("no statistics", f"{where}: got no statistics of {name} in meta/episodes")
    for number in sorted(left):
        recomputed(number)
    _check_total(contents, total.result(), their_total.result(), problems)


def _check_total(contents: Contents, total: Stats, their_total: Stats, problems: Problems) -> None:
    path = contents.root / STATS_NAME
    try:
        if not inside(contents.root, path):
            raise ValueError("a link out of the data set")
        content: dict[str, dict[str, Any]] = json_content(path)
        stored = {name: {k: np.asarray(v, np.float64) for k, v in group.items()} for name, group in content.items()}
    except (OSError, ValueError, AttributeError, TypeError) as error:
        reason = "no such file" if isinstance(error, FileNotFoundError) else damaged(error)
        problems.error("wrong statistics", f"{path}: got {reason}, expected the statistics of all frames")
        return
    for name, feature in contents.features.items():
        if name not in total or is_depth(feature):
            continue
        if name in stored:
            _compare(contents, str(path), name, stored[name], total[name], their_total[name], problems)
        else:
            problems.error("wrong statistics", f"{path}: got no statistics of {name}, expected those of every feature")


def _compare(
    contents: Contents,
    where: str,
    name: str,
    stored: dict[str, Array],
    actual: dict[str, Array],
    theirs: dict[str, Array],
    problems: Problems,
) -> None:
    """Note which of a feature's statistics are not those of its frames or rows."""
    kind = contents.features[name]["dtype"]
    # Frames in videos have lost something since; frames in images may have been sampled in another way.
    resampled = "count" in stored and not np.array_equal(stored["count"].reshape(-1), actual["count"])
    loose = kind == "video" or (kind == "image" and resampled)
    if name in contents.columns:
        stored = reduced(stored, len(actual["mean"]))
    wrong = differing(stored, actual, theirs, LOOSE_CAMERA if loose else 0.0)
    if not wrong:
        return
    message = (
        f"{where}: got {', '.join(wrong)} of {name} that the frames and rows do not give, expected their statistics"
    )
    if name in REQUIRED:
        of = "rows' places" if name in PLACE else "time"
        problems.warning("statistics of places", f"{message} (of the {of} only: LeRobot's own merge leaves them stale)")
    else:
        problems.error("wrong statistics", message)


def episode_statistics(
    contents: Contents, scans: Mapping[str, CameraScan], number: int, *, as_lerobot: bool = False
) -> Stats:
    """Statistics of the episode of span `number`; cameras whose frames cannot be decoded are left out."""
    span: Span = contents.spans[number]
    stats: Stats = {}
    for name in contents.features:
        if name in scans:
            camera = (scans[name].theirs if as_lerobot else scans[name].stats)[number]
            if camera is not None:
                stats[name] = camera
        elif name in contents.columns and contents.columns[name].dtype.kind in "fiub":  # LeRobot has none of words
            values = contents.columns[name][span.start : span.stop]
            stats[name] = of_numbers(values)
            if as_lerobot:
                stats[name] |= rounded([rows_of(values)])
    return stats


def _check_record(contents: Contents, problems: Problems) -> None:
    """Our own record of the episodes' seeds and outcomes, where there is one."""
    path = contents.root / RECORD_NAME
    if not path.is_file():
        return
    try:
        episodes = json_content(path)["episodes"]
        seeds = [entry.get("seed") for entry in episodes]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        problems.error("record", f"{path}: got {damaged(error)}, expected our record of the episodes")
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
