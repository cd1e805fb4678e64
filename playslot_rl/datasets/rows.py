"""Checks of the rows and of the metadata that speak about them. They read no frames.

LeRobot's own reader takes all of this for granted: a stale shard, for instance, gives it more rows than episodes.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np

from playslot_rl.data.contents import INFO_NAME, TASKS_NAME, Contents, Episode, Span
from playslot_rl.data.problems import Problems

TIME_TOLERANCE_S = 1e-4
"""As LeRobot's default; float32 holds it up to about half an hour."""


def check_rows(contents: Contents, problems: Problems) -> None:
    """All checks of this file; findings go to `problems`."""
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
        faults.append(("frame_index", f"got frame_index {_brief(frame)}, expected 0 to {span.length - 1} in order"))
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


def _brief(values: np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> str:
    shown = ", ".join(str(v) for v in values[:4])
    return f"[{shown}{', ...' if len(values) > 4 else ''}]"


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
    _compare(contents, "rows", set(contents.data_files), [contents.data_file], problems)
    present = set((contents.root / "videos").rglob("*.mp4"))
    cameras = [lambda row, camera=camera: contents.video_file(camera, row) for camera in contents.videos]
    _compare(contents, "video", present, cameras, problems)
    leftovers = contents.root / "images"  # LeRobot leaves its folders, but no files unless it was interrupted
    if any(path.is_file() for path in leftovers.rglob("*")):
        problems.warning("leftover", f"{leftovers}: got images of an interrupted recording, expected none: delete them")


def _compare(contents: Contents, what: str, present: set[Path], namers: list, problems: Problems) -> None:  # type: ignore[type-arg]
    named = set()
    for episode in contents.episodes:
        for namer in namers:
            try:
                named.add(namer(episode.row))
            except (KeyError, ValueError, TypeError) as error:
                problems.error(
                    "damaged episode row",
                    f"episode {episode.index}: got no file of its {what} ({error!r}), expected one",
                )
    for path in sorted(named - present):
        if not path.is_file():  # an unreadable one has been noted already
            problems.error(f"missing {what}", f"{path}: got no such file, expected {what} that meta/episodes names")
    for path in sorted(present - named):
        problems.error(
            "stale shard", f"{path}: got a file that no episode names, expected none: it is left from another version"
        )


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
        _check_episode(contents, episode, span, problems)


def _check_episode(contents: Contents, episode: Episode, span: Span, problems: Problems) -> None:
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
    try:
        if contents.data_file(episode.row) != contents.data_files[span.file]:
            there, named = contents.data_files[span.file], contents.data_file(episode.row)
            problems.error("wrong file", f"episode {span.index}: got rows in {there}, expected them in {named}")
    except (KeyError, ValueError, TypeError):
        return  # noted with the files
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
