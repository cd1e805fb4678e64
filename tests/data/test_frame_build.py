"""Decoding into the frame cache: by units, by processes, gone on with after a kill."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from foreign import foreign_frames

from playslot_rl.data import frame_build, source
from playslot_rl.data.agreement import open_files
from playslot_rl.data.cache import Cache
from playslot_rl.data.frame_build import FrameArray, build_frames, units
from playslot_rl.data.source import open_sources

CAMERA = "observation.images.top"


@pytest.fixture(autouse=True)
def small_units(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frame_build, "UNIT_FRAMES", 5)


@pytest.fixture
def decoded(monkeypatch: pytest.MonkeyPatch) -> list[list[int]]:
    """Episodes of each unit that was decoded."""
    found: list[list[int]] = []
    real = FrameArray.decode

    def decode(array: FrameArray, spans: list[frame_build.Span]) -> str:
        found.append([span.index for span in spans])
        return real(array, spans)

    monkeypatch.setattr(FrameArray, "decode", decode)
    return found


def test_units_hold_every_episode_once_and_cross_no_file(foreign_images: Path, foreign_video: Path) -> None:
    for root, camera in ((foreign_images, CAMERA), (foreign_video, CAMERA)):
        files = open_files(root)
        found = units(files, camera)
        assert [span for unit in found for span in unit] == files.spans
        assert len(found) == 3
        assert all(len({span.file for span in unit}) == 1 for unit in found)


@pytest.mark.integration
def test_several_processes_make_the_same_array(foreign_images: Path, foreign_video: Path, tmp_path: Path) -> None:
    one = open_sources(foreign_images, cache=Cache(tmp_path / "one"))
    two = open_sources(foreign_images, cache=Cache(tmp_path / "two", workers=2))
    assert np.array_equal(one.frames[:], np.concatenate(foreign_frames()))
    assert np.array_equal(one.frames[:], two.frames[:])
    files = [next((tmp_path / name / "frames").glob("[0-9a-f]*")) for name in ("one", "two")]
    assert (files[0] / "frames.npy").read_bytes() == (files[1] / "frames.npy").read_bytes()
    assert sorted(path.name for path in files[0].iterdir()) == sorted(path.name for path in files[1].iterdir())


def test_a_build_goes_on_where_it_was_interrupted(
    foreign_images: Path, tmp_path: Path, decoded: list[list[int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    write = frame_build.write_text

    def interrupted(path: Path, text: str) -> None:
        write(path, text)
        if path.name == "00001":
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(frame_build, "write_text", interrupted)
        with pytest.raises(KeyboardInterrupt):
            open_sources(foreign_images, cache=tmp_path)
    assert decoded == [[0], [1]]
    frames = open_sources(foreign_images, cache=tmp_path).frames
    assert decoded == [[0], [1], [2]]
    assert np.array_equal(frames[:], np.concatenate(foreign_frames()))


def test_a_unit_that_is_not_what_its_digest_says_is_decoded_again(
    foreign_images: Path, tmp_path: Path, decoded: list[list[int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    files = open_files(foreign_images)
    with monkeypatch.context() as patch:
        patch.setattr(frame_build, "_decoded", lambda *_: iter(()))
        patch.setattr(Path, "rmdir", lambda _: None)
        build_frames(files, CAMERA, None, tmp_path)
    array = FrameArray(files, CAMERA, None, tmp_path / "frames.npy")
    (tmp_path / "units").mkdir(exist_ok=True)
    for number, spans in enumerate(units(files, CAMERA)):
        (tmp_path / "units" / f"{number:05d}").write_text(array.decode(spans))
    with (tmp_path / "frames.npy").open("r+b") as file:
        file.seek(-5, os.SEEK_END)
        file.write(b"wrong")
    decoded.clear()
    build_frames(files, CAMERA, None, tmp_path)
    assert decoded == [[2]]
    assert np.array_equal(np.load(tmp_path / "frames.npy"), np.concatenate(foreign_frames()))


@pytest.mark.integration
def test_a_killed_build_is_finished_by_the_next_and_its_workers_die_with_it(
    foreign_images: Path, tmp_path: Path
) -> None:
    script = (
        "import sys, time; from playslot_rl.data import frame_build as f; f.UNIT_FRAMES = 5\n"
        "real = f.write_text\n"
        "def slow(path, text):\n    real(path, text); print('unit', flush=True); time.sleep(60)\n"
        "f.write_text = slow\n"
        "from playslot_rl.data.source import open_sources; from playslot_rl.data.cache import Cache\n"
        "if __name__ == '__main__': open_sources(sys.argv[1], cache=Cache(sys.argv[2], workers=2))"
    )
    path = tmp_path / "script.py"
    path.write_text(script)
    with subprocess.Popen(
        [sys.executable, str(path), str(foreign_images), str(tmp_path / "cache")], stdout=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"unit\n"
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
        workers = [int(pid) for pid in children.read_text().split()] if children.is_file() else []
        process.send_signal(signal.SIGKILL)
    deadline = time.monotonic() + 20
    while any(Path(f"/proc/{pid}").exists() and _alive(pid) for pid in workers) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(_alive(pid) for pid in workers)
    found = source.open_sources(foreign_images, cache=tmp_path / "cache")
    assert np.array_equal(found.frames[:], np.concatenate(foreign_frames()))
    assert not list((tmp_path / "cache" / "frames").glob(".*.part"))


def _alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_only_the_row_groups_that_are_wanted_are_read(foreign_images: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from pyarrow import parquet

    from playslot_rl.data.frames import rgb_frames

    read: list[list[int]] = []
    real = parquet.ParquetFile.iter_batches

    def iter_batches(file: parquet.ParquetFile, size: int, row_groups: list[int], columns: list[str]) -> object:
        read.append(row_groups)
        return real(file, size, row_groups=row_groups, columns=columns)

    monkeypatch.setattr(parquet.ParquetFile, "iter_batches", iter_batches)
    files = open_files(foreign_images)
    groups = sum(parquet.ParquetFile(path).num_row_groups for path in files.data_files)
    rows = [row for row, _ in rgb_frames(files, CAMERA, [files.spans[2]])]
    assert rows == list(range(files.spans[2].start, files.spans[2].stop))
    assert groups == 3  # LeRobot writes one an episode
    assert sum(map(len, read)) == 1


def test_a_video_is_sought_and_not_read_from_its_beginning(foreign_video: Path) -> None:
    from playslot_rl.data.frames import rgb_frames

    files = open_files(foreign_video)
    whole = dict(rgb_frames(files, CAMERA))
    last = dict(rgb_frames(files, CAMERA, files.spans[2:]))
    assert sorted(last) == list(range(files.spans[2].start, files.spans[2].stop))
    assert all(np.array_equal(last[row], whole[row]) for row in last)
