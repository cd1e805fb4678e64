"""Hostile sets under every command: one line, at once, nothing written elsewhere, nothing called sound."""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from hostile import CONTENT, HARMLESS, METADATA

from playslot_rl import cli
from playslot_rl.data.source import open_sources
from playslot_rl.datasets.verify import verify
from playslot_rl.errors import DataError

ROWS = METADATA | CONTENT
SECONDS = 5.0
COMMANDS = {
    "info": ("info", "SET"),
    "viz": ("viz", "SET", "--episodes", "1", "--out", "OUT/page.html"),
    "merge": ("merge", "SET", "OTHER", "--out", "OUT/merged"),
    "merge as the second": ("merge", "OTHER", "SET", "--out", "OUT/merged"),
    "split": ("split", "SET", "--out", "OUT/parts", "--fractions", "a=0.5,b=0.5"),
    "repair": ("repair", "SET", "--out", "OUT/repaired"),
}


@pytest.fixture
def hostile(images: Path, tmp_path: Path) -> Path:
    """A sound set, to be made hostile, beside another sound one."""
    shutil.copytree(images, tmp_path / "other")
    return Path(shutil.copytree(images, tmp_path / "set"))


def files(folder: Path) -> dict[str, tuple[int, int]]:
    return {str(p): (p.stat().st_size, p.stat().st_mtime_ns) for p in folder.rglob("*") if p.is_file()}


@pytest.mark.integration
@pytest.mark.parametrize("name", ROWS)
def test_verify_never_calls_it_sound(name: str, hostile: Path) -> None:
    ROWS[name](hostile)
    begun = time.monotonic()
    result = verify(hostile)
    assert time.monotonic() - begun < SECONDS
    assert result.ok == (name in HARMLESS), result.errors
    for line in result.errors:
        assert "\n" not in line
        assert len(line) < 600


@pytest.mark.slow
@pytest.mark.parametrize("name", ROWS)
def test_every_command_ends_in_a_line(name: str, hostile: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ROWS[name](hostile)
    folder, out = hostile.parent, hostile.parent / "out"
    before = files(folder)
    for label, words in COMMANDS.items():
        shutil.rmtree(out, ignore_errors=True)
        places = {"SET": str(hostile), "OTHER": str(folder / "other")}
        arguments = [str(out / word[4:]) if word.startswith("OUT/") else places.get(word, word) for word in words]
        begun = time.monotonic()
        code = cli.main(["dataset", *arguments])
        taken, said = time.monotonic() - begun, capsys.readouterr().err
        assert code in (0, 1)
        assert "unexpected" not in said, (label, said)
        assert said.count("\n") == code, (label, said)
        assert taken < SECONDS or label == "viz", label  # which imports matplotlib, once
        assert {path: facts for path, facts in files(folder).items() if not path.startswith(str(out))} == before
        if words[0] in ("merge", "repair") and code == 0 and (out / words[-1].removeprefix("OUT/")).is_dir():
            assert verify(out / words[-1].removeprefix("OUT/")).ok, label


@pytest.mark.integration
@pytest.mark.parametrize("name", ROWS)
def test_training_reads_it_or_says_in_a_line_why_not(
    name: str, hostile: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ROWS[name](hostile)
    try:
        source = open_sources(hostile, cache=tmp_path / "cache")
    except DataError as error:
        said = str(error)
        source = None
    if source is None:
        assert "\n" not in said
        assert str(hostile) in said
        return
    assert source.frames.shape == (15, 32, 32, 3)
    assert source.lengths.tolist() == [5, 3, 7]
    said = capsys.readouterr().err
    if not verify(hostile, statistics=False).ok:
        assert said.startswith("note: ")
        assert "stage 1 does not need that" in said
        assert said.count("\n") == 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["width of ten digits", "zeros of ten digits", "lists in lists"])
def test_the_command_itself_ends_at_once(name: str, hostile: Path) -> None:
    ROWS[name](hostile)
    for action in ("verify", "info", "repair"):
        done = subprocess.run(
            [sys.executable, "-m", "playslot_rl", "dataset", action, str(hostile)],
            capture_output=True,
            text=True,
            timeout=60,
        )
        assert done.returncode == 1
        assert "unexpected" not in done.stdout + done.stderr
        assert "info.json" in done.stdout + done.stderr


def test_another_rate_of_pictures_is_not_needed_and_of_videos_refused(
    images: Path, video: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from damage import edit_json

    pictures, films = (Path(shutil.copytree(root, tmp_path / root.name)) for root in (images, video))
    for root in (pictures, films):
        edit_json(root, "meta/info.json", lambda info: info.update(fps=99))
    assert open_sources(pictures, cache=tmp_path / "cache").fps == 99
    assert "stage 1 does not need that" in capsys.readouterr().err
    with pytest.raises(DataError, match="got fps 99, expected the rate of its videos"):
        open_sources(films, "observation.images.top", cache=tmp_path / "cache")


def test_a_folder_of_the_hubs_cache_is_whole_though_its_files_are_links(images: Path, tmp_path: Path) -> None:
    blobs, snapshot = tmp_path / "datasets--me--set" / "blobs", tmp_path / "datasets--me--set" / "snapshots" / "abc"
    blobs.mkdir(parents=True)
    for number, path in enumerate(sorted(path for path in images.rglob("*") if path.is_file())):
        shutil.copy(path, blobs / str(number))
        link = snapshot / path.relative_to(images)
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(blobs / str(number))
    assert verify(snapshot).errors == ()
    assert len(open_sources(snapshot, cache=tmp_path / "cache").frames) == 15
