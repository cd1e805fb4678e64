"""Whether a data set is what it says it is: counts, indices, timestamps, frames, statistics; and its fingerprint."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from playslot_rl.data.contents import (
    INFO_NAME,
    PLACE,
    RECORD_NAME,
    REQUIRED,
    STATS_NAME,
    Contents,
    Span,
    episode_files,
    is_depth,
    read_contents,
)
from playslot_rl.data.problems import Problems
from playslot_rl.data.tables import TASKS_NAME, Array, Episode, Stats, stored_episodes
from playslot_rl.datasets.fingerprint import CameraScan, fingerprint_of, scan_frames
from playslot_rl.datasets.statistics import Aggregate, differing, of_numbers, reduced, rounded, rows_of
from playslot_rl.errors import DataError

TIME_TOLERANCE_S = 1e-4
"""As LeRobot's default; float32 holds it up to about half an hour."""
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
        contents = read_contents(root, problems, statistics=False)
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


def check_rows(contents: Contents, problems: Problems) -> None:
    """Check the rows and the metadata that speak about them; reads no frames. Findings go to `problems`.

    LeRobot's own reader takes all of this for granted: a stale shard, for instance, gives it more rows than episodes.
    """
    _check_counts(contents, problems)
    _check_files(contents, problems)
    _check_episodes(contents, problems)
    for span in contents.spans:
        for kind, fault in row_faults(contents, span):
            problems.error(kind, f"episode {span.index}: {fault}")
    _check_places(contents, problems)


def row_faults(contents: Contents, span: Span) -> list[tuple[str, str]]:
    """What is wrong with the rows of one episode, whatever else the data set holds: (kind, message)."""
    rows = slice(span.start, span.stop)
    faults = []
    frame = contents.columns["frame_index"][rows]
    if not np.array_equal(frame, np.arange(span.length)):
        shown = ", ".join([str(number) for number in frame[:4]] + ["..."] * (span.length > 4))
        faults.append(("frame_index", f"got frame_index [{shown}], expected 0 to {span.length - 1} in order"))
    late = np.abs(contents.columns["timestamp"][rows].astype(np.float64) - np.arange(span.length) / contents.fps)
    if not bool((late <= TIME_TOLERANCE_S).all()):
        worst = int(np.argmax(np.nan_to_num(late, nan=np.inf)))
        got = contents.columns["timestamp"][rows][worst]
        faults.append(
            (
                "timestamp",
                f"got timestamp {got:.6g} at frame {worst}, expected {worst / contents.fps:.6g} (frame / fps)",
            )
        )
    unknown = set(contents.columns["task_index"][rows].tolist()) - set(contents.tasks)
    if unknown:
        faults.append(("task_index", f"got task_index {sorted(unknown)}, expected one of {TASKS_NAME}"))
    for name, values in contents.columns.items():
        if values.dtype.kind == "f" and not np.isfinite(values[rows]).all():
            faults.append(("not finite", f"got a value of {name} that is NaN or infinite, expected numbers"))
    return faults


def length_fault(episode: Episode, span: Span) -> str:
    """Disagreement of an episode's metadata with its number of rows, or nothing."""
    if episode.length == span.length:
        return ""
    return f"got {span.length} rows, expected {episode.length} as in meta/episodes"


def _check_counts(contents: Contents, problems: Problems) -> None:
    info = contents.info
    for name, got in (
        ("total_frames", contents.rows),
        ("total_episodes", len(contents.episodes)),
        ("total_tasks", len(contents.tasks)),
    ):
        if name in info and int(info[name]) != got:
            problems.error("wrong count", f"{INFO_NAME}: got {name} {info[name]}, but the files hold {got}")
    if not contents.rows:
        problems.error("empty", f"{contents.root}: got no readable rows, expected episodes")
    expected = f"0:{len(contents.episodes)}"
    splits = info.get("splits") or {}
    if set(splits) == {"train"} and splits["train"] != expected:
        problems.warning("splits", f"{INFO_NAME}: got splits train={splits['train']}, expected {expected}")


def _check_files(contents: Contents, problems: Problems) -> None:
    """Every file that is named is there, and every file that is there is named."""
    of_rows = [(episode, contents.data_file(episode.row)) for episode in contents.episodes]
    of_video = [(e, contents.video_file(camera, e.row)) for e in contents.episodes for camera in contents.videos]
    videos = set((contents.root / "videos").rglob("*.mp4"))
    for what, present, namers in (("rows", set(contents.data_files), of_rows), ("video", videos, of_video)):
        for episode, path in namers:
            if path is None:
                problems.error(
                    "damaged episode row", f"episode {episode.index}: got no file of its {what}, expected one"
                )
        named = {path for _, path in namers if path is not None}
        for path in sorted(named - present):
            if not path.is_file():  # an unreadable one has been noted already
                problems.error(f"missing {what}", f"{path}: got no such file, expected {what} that meta/episodes names")
        for path in sorted(present - named):
            problems.error(
                "stale shard",
                f"{path}: got a file that no episode names, expected none: it is left from another version",
            )
    leftovers = contents.root / "images"  # LeRobot leaves its folders, but no files unless it was interrupted
    if any(path.is_file() for path in leftovers.rglob("*")):
        problems.warning("leftover", f"{leftovers}: got images of an interrupted recording, expected none: delete them")


def _check_episodes(contents: Contents, problems: Problems) -> None:
    numbers = [episode.index for episode in contents.episodes]
    if numbers != list(range(len(numbers))):
        problems.error(
            "episode_index", f"meta/episodes: got episodes {numbers[:6]}..., expected 0, 1, 2, ... each once"
        )
    by_index = {episode.index: episode for episode in contents.episodes}
    rows_of = Counter(span.index for span in contents.spans)
    for index in sorted(set(by_index) - set(rows_of)):
        problems.error("missing rows", f"episode {index}: got no rows, expected {by_index[index].length}")
    for index, runs in rows_of.items():
        if runs > 1:
            problems.error("episode_index", f"episode {index}: got rows in {runs} places, expected one run of rows")
    for span in contents.spans:
        episode = by_index.get(span.index)
        if episode is None:
            problems.error("missing metadata", f"episode {span.index}: got rows, but no row in meta/episodes")
            continue
        fault = length_fault(episode, span)
        if fault:
            problems.error("wrong length", f"episode {span.index}: {fault}")
        _check_metadata(contents, episode, span, problems)


def _check_metadata(contents: Contents, episode: Episode, span: Span, problems: Problems) -> None:
    place = (episode.row.get("dataset_from_index"), episode.row.get("dataset_to_index"))
    if place != (span.start, span.stop):
        problems.error(
            "dataset_from_index",
            f"episode {span.index}: got dataset_from_index, dataset_to_index {place}, expected {span.start, span.stop}",
        )
    words = {contents.tasks.get(int(n)) for n in contents.columns["task_index"][span.start : span.stop]}
    if words != set(episode.tasks):
        got = sorted(map(str, words))
        problems.error(
            "tasks", f"episode {span.index}: got tasks {got} in its rows, expected {sorted(episode.tasks)} as stated"
        )
    there, named = contents.data_files[span.file], contents.data_file(episode.row)
    if named is None:
        return  # noted with the files
    if named != there:
        problems.error("wrong file", f"episode {span.index}: got rows in {there}, expected them in {named}")
    for camera in contents.videos:
        begin, end = (episode.row.get(f"videos/{camera}/{side}_timestamp") for side in ("from", "to"))
        if begin is None or end is None or abs((end - begin) * contents.fps - span.length) > 0.5:
            problems.error(
                "video timestamps",
                f"episode {span.index}: got {camera} from {begin} to {end} s, expected {span.length} frames of it",
            )


def _check_places(contents: Contents, problems: Problems) -> None:
    index = contents.columns["index"]
    wrong = np.flatnonzero(index != np.arange(len(index)))
    if len(wrong):
        row = int(wrong[0])
        problems.error("index", f"row {row}: got index {index[row]}, expected {row} (and {len(wrong) - 1} more rows)")
    order = [span.index for span in contents.spans]
    if order != sorted(order):
        problems.error("episode_index", f"got rows of episodes in the order {order[:6]}..., expected ascending")
    for episode in contents.episodes:
        chunk, file = (episode.row.get(f"meta/episodes/{name}_index") for name in ("chunk", "file"))
        if chunk is not None and file is not None:
            path = contents.root / f"meta/episodes/chunk-{chunk:03d}/file-{file:03d}.parquet"
            if not path.is_file():
                problems.warning(
                    "meta/episodes", f"episode {episode.index}: names {path}, which is not there: LeRobot's own "
                    "merge_datasets leaves such rows, and its split_dataset fails on them",
                )  # fmt: skip


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
    for episode in stored_episodes(episode_files(contents.root)):
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
        content: dict[str, dict[str, Any]] = json.loads(path.read_text())
        stored = {name: {k: np.asarray(v, np.float64) for k, v in group.items()} for name, group in content.items()}
    except (OSError, ValueError, AttributeError, TypeError) as error:
        reason = "no such file" if isinstance(error, FileNotFoundError) else f"{error!r}"
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
    """Statistics of the episode of span `number`; cameras whose frames cannot be decoded are left out.

    Args:
        contents: the data set.
        scans: its frames.
        number: of the span.
        as_lerobot: means and standard deviations with LeRobot's rounding, not exact.
    """
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
