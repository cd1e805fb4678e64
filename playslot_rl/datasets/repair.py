"""What is whole in a damaged data set, as a sound one.

An episode is kept if its rows are complete and every frame of it can be decoded; the others are left out, and the kept
ones numbered anew. Counts, indices, statistics and, where a kill before `finalize` left none, the metadata of episodes
are made anew from the rows and frames. A parquet file without a footer cannot be read: its episodes are lost.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from playslot_rl.data.agreement import length_fault, row_faults
from playslot_rl.data.contents import Contents, Span, read_contents
from playslot_rl.data.places import Problems
from playslot_rl.data.tables import UNREADABLE, Episode, Stats
from playslot_rl.datasets.assemble import Choice, assemble
from playslot_rl.datasets.fingerprint import CameraScan, scan_frames
from playslot_rl.datasets.statistics import differing
from playslot_rl.datasets.verify import LOOSE_CAMERA, Verification, episode_statistics, verify
from playslot_rl.datasets.video_copy import frame_count, video_place
from playslot_rl.errors import DataError, OutputError
from playslot_rl.storage.atomic import explain_write_errors, fsync_folder
from playslot_rl.storage.folders import by_name, held, new_folder, require_free


@dataclass(frozen=True)
class RepairResult:
    """What `repair` did: episodes the damaged one `stated` (None where nothing was wrong), what is `lost`, a line each,
    where the `damaged` one is kept, if it was replaced, and the `journal` of an unfinished collection beside it."""

    root: Path
    verification: Verification
    stated: int | None
    lost: tuple[str, ...]
    damaged: Path | None
    journal: Path | None

    def lines(self) -> list[str]:
        made = self.verification
        if self.stated is None:
            return [f"{self.root}: sound, nothing to repair ({made.episodes} episodes, {made.frames} frames)"]
        found = [f"lost: {line}" for line in self.lost] or ["lost: nothing; counts, indices and statistics made anew"]
        found.append(f"{self.root}: {made.episodes} of {self.stated} episodes restored, {made.frames} frames, verified")
        if self.damaged is not None:
            found.append(f"the damaged data set is kept as {self.damaged}")
        if self.journal is not None:
            found.append(_journal_note(self.journal))
        return found


def repair(root: str | Path, out: str | Path | None = None) -> RepairResult:
    """Restore a data set that was never finalised, was interrupted, or is damaged.

    The repaired one is written under a temporary name and verified. Then the damaged one is renamed to `NAME.damaged`
    and the repaired one takes its place, unless `out`, a new folder, says where it goes. A sound one is left alone.

    Raises:
        DataError: there is no whole episode, or no `meta/info.json` to begin with.
        OutputError: `out` exists, another command repairs in the same place, or the disk is full.
    """
    folder = by_name(Path(root))
    if out is not None:
        require_free(Path(out), "--out ")
        return _repair(folder, Path(out))
    repaired = _beside(folder)
    if not folder.exists() and repaired.is_dir() and verify(repaired).ok:
        repaired.rename(folder)  # a kill came between the two renames
    if not folder.is_dir():
        return _repair(folder, None)  # which says so
    with held(folder) as free:
        if not free:
            raise OutputError(f"{folder}: another command repairs it, expected none: wait for that one to end")
        return _repair(folder, None)


def _repair(folder: Path, out: Path | None) -> RepairResult:
    before = verify(folder)
    journal = folder.with_name(f"{folder.name}.journal")
    beside = journal if journal.is_dir() else None
    if before.ok:
        return RepairResult(folder, before, None, (), None, None)
    problems = Problems()
    contents = read_contents(folder, problems)
    lost = [*problems.of(UNREADABLE)]
    choice = _whole_episodes(contents, lost)
    if not choice.spans:
        more = f"; {_journal_note(beside)}" if beside else "; record it again"
        raise DataError(f"{folder}: got no whole episode to restore ({(lost or before.errors)[0]}), expected one{more}")
    stated = int(contents.info["total_episodes"])
    repaired = _beside(folder) if out is None else out
    with new_folder(repaired, replace=out is None, key="--out ") as temporary:
        assemble([choice], temporary, "playslot dataset repair")
        result = verify(temporary)
        if not result.ok:
            raise DataError(
                f"{folder}: cannot be repaired: got {result.errors[0]} after it, expected a sound data set; "
                "it was left as it is"
            )
    if out is not None:
        return RepairResult(repaired, result, stated, tuple(lost), None, beside)
    damaged = _free_name(folder)
    with explain_write_errors(folder):
        folder.rename(damaged)
        try:
            repaired.rename(folder)
        except FileNotFoundError:
            if not folder.is_dir():  # else another command, which took this one for killed, has done it
                raise
        fsync_folder(folder.absolute().parent)
    return RepairResult(folder, result, stated, tuple(lost), damaged, beside)


def _journal_note(journal: Path) -> str:
    return (
        f"{journal} holds the episodes of an unfinished collection: `playslot collect` with the same arguments as "
        "then may restore more than a repair"
    )


def _beside(folder: Path) -> Path:
    """Where the repaired one waits for its place; nobody else's name, so that what a kill left there is replaced."""
    return folder.with_name(f".{folder.name}.repaired")


def _free_name(folder: Path) -> Path:
    for number in range(1, 1000):
        name = folder.with_name(f"{folder.name}.damaged" + (f"-{number}" if number > 1 else ""))
        if not name.exists():
            return name
    raise OutputError(f"{folder}: got a thousand damaged copies beside it, expected fewer; delete some")


def _whole_episodes(contents: Contents, lost: list[str]) -> Choice:
    """The episodes that can be kept, with metadata and statistics made anew; the others go to `lost`."""
    scans = scan_frames(contents, Problems())
    stale = _stale_files(contents)
    lost += [f"{contents.data_files[n]}: left from another version, its rows are double" for n in sorted(stale)]
    known = {episode.index: episode for episode in contents.episodes}
    located = _locate_videos(contents, [span for span in contents.spans if span.file not in stale], known)
    if set(located) != set(known):  # frames of episodes without metadata are found only now
        found = {**known, **located}
        contents = replace(contents, episodes=[found[index] for index in sorted(found)])
        scans = scan_frames(contents, Problems())
    spans, episodes, seen = [], [], set()
    for number, span in enumerate(contents.spans):
        if span.file in stale:
            continue
        episode = located.get(span.index)
        reason = "its rows are there twice"
        if span.index not in seen:
            reason = _reason(contents, scans, span, known.get(span.index), episode)
        if reason or episode is None:
            lost.append(f"episode {span.index} ({span.length} rows): {reason}")
            continue
        seen.add(span.index)
        spans.append(span)
        episodes.append(replace(episode, stats=_statistics(contents, scans, number, episode)))
    lost += _gone(set(known), {span.index for span in contents.spans}, int(contents.info["total_episodes"]))
    return Choice(contents, spans, episodes)


def _gone(known: set[int], there: set[int], stated: int) -> list[str]:
    """A line about the episodes that have metadata, or a number below the stated one, and no rows."""
    missing = (number for number in itertools.count() if number not in there)
    beyond = sorted(number for number in known - there if number >= stated)
    below = stated - sum(number < stated for number in there)
    shown = [*itertools.islice(missing, min(below, 8)), *beyond][:8]
    more = f" and {below + len(beyond) - 8} more" if below + len(beyond) > 8 else ""
    return [f"episodes {', '.join(map(str, shown))}{more}: no rows are left of them"] if shown else []


def _reason(
    contents: Contents, scans: Mapping[str, CameraScan], span: Span, known: Episode | None, located: Episode | None
) -> str:
    """Why an episode cannot be kept, or nothing."""
    fault = length_fault(known, span) if known is not None else ""
    if fault:
        return fault
    faults = row_faults(contents, span)
    if faults:
        return faults[0][1]
    if located is None:
        return "its video is missing or too short"
    for camera, scan in scans.items():
        damaged = sum(not digest for digest in scan.digests[span.start : span.stop])
        if damaged:
            return f"{damaged} of {span.length} frames of {camera} cannot be decoded"
    return ""


def _statistics(contents: Contents, scans: Mapping[str, CameraScan], number: int, episode: Episode) -> Stats:
    """Those of numbers anew; those of cameras as they were taken before compression, where they are there."""
    fresh = episode_statistics(contents, scans, number)
    stored = {name: stats for name, stats in episode.stats.items() if name in contents.videos and name in fresh}
    sound = {name: stats for name, stats in stored.items() if not differing(stats, fresh[name], loose=LOOSE_CAMERA)}
    depth = {name: stats for name, stats in episode.stats.items() if name in scans and name not in fresh}
    return {**depth, **fresh, **sound}


def _stale_files(contents: Contents) -> set[int]:
    """Data files that no episode names although all of their episodes have metadata that name others."""
    named = {contents.data_file(episode.row) for episode in contents.episodes}
    known = {episode.index for episode in contents.episodes}
    held = [{span.index for span in contents.spans if span.file == n} for n in range(len(contents.data_files))]
    return {n for n, path in enumerate(contents.data_files) if path not in named and held[n] <= known}


def _locate_videos(contents: Contents, spans: list[Span], known: Mapping[int, Episode]) -> dict[int, Episode]:
    """Metadata of each episode: its own, or made from its rows and the order in which LeRobot joins videos."""
    counts = {camera: _video_files(contents, camera) for camera in contents.videos}
    position = dict.fromkeys(contents.videos, (0, 0))
    located: dict[int, Episode] = {}
    for span in spans:
        episode = known.get(span.index)
        if episode is None:
            row: dict[str, Any] = {}
            for camera, files in counts.items():
                row |= _next_place(contents, camera, files, position[camera], span.length)
            if any(f"videos/{camera}/from_timestamp" not in row for camera in contents.videos):
                continue
            numbers = contents.columns["task_index"][span.start : span.stop].tolist()
            tasks = tuple(dict.fromkeys(contents.tasks[n] for n in numbers if n in contents.tasks))
            episode = Episode(span.index, span.length, tasks, row, {})
        located[span.index] = episode
        for camera, files in counts.items():
            name = f"videos/{camera}"
            place = episode.row.get(f"{name}/chunk_index"), episode.row.get(f"{name}/file_index")
            times = contents.video_times(camera, episode.row)
            numbers = [number for number, file in enumerate(files) if file[:2] == place]
            if numbers and times is not None:
                position[camera] = numbers[0], round(times[1] * contents.fps)
    return located


Place = tuple[int, int, int]  # chunk, file, and number of frames


def _video_files(contents: Contents, camera: str) -> list[Place]:
    found: list[Place] = []
    for path in sorted((contents.root / "videos" / camera).glob("chunk-*/file-*.mp4")):
        if not contents.holds(path):
            continue
        try:
            chunk, file = int(path.parent.name.removeprefix("chunk-")), int(path.stem.removeprefix("file-"))
            found.append((chunk, file, frame_count(path)))
        except (ValueError, DataError):
            continue
    return found


def _next_place(
    contents: Contents, camera: str, files: list[Place], position: tuple[int, int], length: int
) -> dict[str, Any]:
    number, frame = position
    if number < len(files) and frame + length > files[number][2]:
        number, frame = number + 1, 0
    if number >= len(files) or frame + length > files[number][2]:
        return {}
    begin, end = frame / contents.fps, (frame + length) / contents.fps
    return video_place(camera, *files[number][:2], begin, end)
