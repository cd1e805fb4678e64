"""Whether a data set's rows and the metadata that speak about them agree, and whether it can be trained on; no frame is
read.

LeRobot's own reader takes all of this for granted: a stale shard, for instance, gives it more rows than episodes.
"""

from __future__ import annotations

import functools
import sys
from collections import Counter
from pathlib import Path
from typing import Final

import numpy as np

from playslot_rl.config.weights import is_remote
from playslot_rl.data.contents import Contents, Span, read_contents
from playslot_rl.data.metadata import EPISODES_PATH, INFO_NAME, NUMBERS, OTHERS
from playslot_rl.data.places import CLUTTER, OUTSIDE, SHOWN, Problems, filled, is_clutter, parquet_files
from playslot_rl.data.tables import MISSING, TASKS_NAME, UNREADABLE, WRONG_COLUMN, Episode
from playslot_rl.errors import DataError
from playslot_rl.runtime.processes import here

TIME_TOLERANCE_S: Final = 1e-4  # as LeRobot's default; float32 holds it up to about half an hour
DISORDER: Final = ("episode order", "missing episode", "missing metadata", "wrong length", "frame order")
"""Kinds of faults after which nobody knows which rows follow on which."""


def check_rows(contents: Contents, problems: Problems) -> None:
    """Check all of it; findings go to `problems`."""
    _check_types(contents, problems)
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
        kind = "frame_index" if (np.diff(frame) > 0).all() else "frame order"
        faults.append((kind, f"got frame_index [{shown}], expected 0 to {span.length - 1} in order"))
    late = np.abs(contents.columns["timestamp"][rows].astype(np.float64) - np.arange(span.length) / contents.fps)
    if not bool((late <= TIME_TOLERANCE_S).all()):
        worst = int(np.argmax(np.nan_to_num(late, nan=np.inf)))
        got, expected = contents.columns["timestamp"][rows][worst], worst / contents.fps
        fault = f"got timestamp {got:.6g} at frame {worst}, expected {expected:.6g} (frame / fps)"
        faults.append(("timestamp", fault))
    unknown = set(np.unique(contents.columns["task_index"][rows]).tolist()) - contents.tasks.keys()
    if unknown:
        faults.append(("task_index", f"got task_index {sorted(unknown)}, expected one of {TASKS_NAME}"))
    for name, values in contents.columns.items():
        if values.dtype.kind == "f" and not np.isfinite(values[rows]).all():
            faults.append(("not finite", f"got a value of {name} that is NaN or infinite, expected numbers"))
    return faults


def _check_types(contents: Contents, problems: Problems) -> None:
    """What each feature is said to be, beside what its column holds; `read_columns` has refused text for numbers."""
    kinds = {"f": "float", "i": "int", "u": "uint", "b": "bool"}
    for name, feature in contents.features.items():
        dtype, values = feature["dtype"], contents.columns.get(name)
        if not NUMBERS.fullmatch(dtype) and dtype not in OTHERS:
            problems.error("unknown type", f"{INFO_NAME}: got {name} of type {dtype[:40]!r}, expected one of LeRobot's")
        elif values is not None and len(values) and not dtype.startswith(kinds.get(values.dtype.kind, "")):
            problems.warning(
                "other type", f"got {name} as {values.dtype} in data/, expected {dtype} as stated in {INFO_NAME}"
            )


def length_fault(episode: Episode, span: Span) -> str:
    """Disagreement of an episode's metadata with its number of rows, or nothing."""
    if episode.length == span.length:
        return ""
    return f"got {span.length} rows, expected {episode.length} as in meta/episodes"


def _check_counts(contents: Contents, problems: Problems) -> None:
    info, of_tasks = contents.info, len(contents.tasks)
    held = {"total_frames": contents.rows, "total_episodes": len(contents.episodes), "total_tasks": of_tasks}
    for name, got in held.items():
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
    videos = {path for path in (contents.root / "videos").rglob("*.mp4") if not is_clutter(path)}
    for what, present, namers in (("rows", set(contents.data_files), of_rows), ("video", videos, of_video)):
        for episode, path in namers:
            if path is None:
                problems.error(
                    "damaged episode row", f"episode {episode.index}: got no file of its {what}, expected one"
                )
        named = {path for _, path in namers if path is not None}
        for path in sorted(named - present):
            if not path.is_file():  # an unreadable one has been noted already
                problems.error(
                    f"missing file of {what}", f"{path}: got no such file, expected {what} that meta/episodes names"
                )
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
            "episode numbers", f"meta/episodes: got episodes {numbers[:6]}..., expected 0, 1, 2, ... each once"
        )
    by_index = {episode.index: episode for episode in contents.episodes}
    rows_of = Counter(span.index for span in contents.spans)
    for index in sorted(set(by_index) - set(rows_of)):
        problems.error("missing episode", f"episode {index}: got no rows, expected {by_index[index].length}")
    for index, runs in rows_of.items():
        if runs > 1:
            problems.error("episode order", f"episode {index}: got rows in {runs} places, expected one run of rows")
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
    numbers = np.unique(contents.columns["task_index"][span.start : span.stop])
    words = {contents.tasks.get(number) for number in numbers.tolist()}
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
        times = contents.video_times(camera, episode.row)
        if times is None or abs((times[1] - times[0]) * contents.fps - span.length) > 0.5:
            begin, end = (str(episode.row.get(f"videos/{camera}/{side}_timestamp"))[:40] for side in ("from", "to"))
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
        problems.error("episode order", f"got rows of episodes in the order {order[:6]}..., expected ascending")
    is_file = functools.cache(Path.is_file)  # thousands of episodes name the same few files
    for episode in contents.episodes:
        chunk, file = (episode.row.get(f"meta/episodes/{name}_index") for name in ("chunk", "file"))
        if chunk is not None and file is not None:
            place = filled(EPISODES_PATH, chunk, file)
            if place is None:
                problems.error("damaged episode row", f"episode {episode.index}: got no place of its metadata")
            elif not is_file(path := contents.root / place):
                problems.warning(
                    "meta/episodes", f"episode {episode.index}: names {path}, which is not there: LeRobot's own "
                    "merge_datasets leaves such rows, and its split_dataset fails on them",
                )  # fmt: skip


def open_files(root: str | Path) -> Contents:
    """Read a data set for training, without statistics, after a check that its files are all there and agree.

    What is wrong with it and no frame depends on is said in a line, once.

    Raises:
        DataError: no such set, none of this version, unfinalised, truncated or empty; or its rows are out of order.
    """
    folder, expected = Path(root).expanduser(), "expected a LeRobot"
    if not str(root):
        raise DataError(f"data.root is empty, {expected} data set's folder: set data.root=")
    if is_remote(root):
        raise DataError(
            f"{root}: got a data set on the Hub, expected a folder, or data.stream=true where videos are trained on: "
            "pull it by `playslot dataset pull USER/NAME DIR`"
        )
    if not folder.is_dir():
        raise DataError(
            f"{root}: no such folder, {expected} data set: check the path; `playslot collect` records one, "
            "`playslot dataset pull USER/NAME DIR` downloads one of the Hub"
        )
    problems = Problems()
    contents = read_contents(folder, problems, statistics=False)
    unfinished = (
        "it was never finalised, or is truncated: collect it again (the same `playslot collect` command carries on), "
        "or call finalize() on the LeRobotDataset that wrote it"
    )
    if problems.of(OUTSIDE):
        raise DataError(problems.of(OUTSIDE)[0])
    if not parquet_files(folder, "data") or not parquet_files(folder, "meta/episodes"):
        raise DataError(f"{root}: got no rows under data/ and meta/episodes/, expected parquet files; {unfinished}")
    if problems.of(UNREADABLE):
        raise DataError(f"{problems.of(UNREADABLE)[0]}; {unfinished}")
    if problems.of(WRONG_COLUMN):
        raise DataError(f"{problems.of(WRONG_COLUMN)[0]}: run `playslot dataset verify` on it")
    lengths, info = sum(episode.length for episode in contents.episodes), contents.info
    stated = int(info["total_frames"]), int(info["total_episodes"])
    if stated != (contents.rows, len(contents.episodes)) or lengths != contents.rows:
        raise DataError(
            f"{root}: got {contents.rows} rows and {len(contents.episodes)} episodes of {lengths} frames, expected "
            f"{stated[0]} frames in {stated[1]} episodes as in {INFO_NAME}; {unfinished}"
        )
    if not contents.rows:
        raise DataError(f"{root}: got an empty data set, expected episodes: collect some first")
    _require_order(contents, problems)
    return contents


def _require_order(contents: Contents, problems: Problems) -> None:
    """Refuse rows that are out of order, and say what else is wrong."""
    check_rows(contents, problems)
    disorder = [line for kind in DISORDER for line in problems.of(kind)]
    if disorder:
        raise DataError(
            f"{contents.root}: {disorder[0]}; got rows that nobody knows the order of, expected whole episodes: run "
            "`playslot dataset repair` on it"
        )
    moving = sum(span.length > 1 for span in contents.spans)
    if contents.videos and moving and len(problems.of("timestamp")) >= moving:
        raise DataError(
            f"{contents.root}: {problems.of('timestamp')[0]}; got fps {contents.fps:g}, expected the rate of its "
            f"videos, at which their frames are found: mend {INFO_NAME}"
        )
    if problems.errors:
        more = f" (and {len(problems.errors) - 1} more)" if len(problems.errors) > 1 else ""
        say_once(
            f"note: {contents.root}: {problems.errors[0].replace(f'{contents.root}/', '')}{more}; stage 1 does not "
            "need that and trains, LeRobot's reader may fail: run `playslot dataset verify`, then `repair`"
        )
    for line in [*problems.warnings_of(CLUTTER)[:SHOWN], *problems.warnings_of(MISSING)[:SHOWN]]:
        say_once(f"note: {line}")


@functools.cache
def say_once(line: str) -> None:
    """Once, by one of several processes."""
    if here().first:
        print(line, file=sys.stderr, flush=True)
