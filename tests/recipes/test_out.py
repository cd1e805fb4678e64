"""Where commands write: never into a data set that somebody reads, and what cannot be written ends in one line."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

import pytest
from commands import assert_one_line, contents, playslot

from playslot_rl.config.compose import compose
from playslot_rl.errors import OutputError

pytestmark = pytest.mark.integration

COMMANDS = [
    "collect", "convert", "train-slots", "train-dynamics", "train-policy", "train-baseline", "evaluate", "inspect",
    "plan", "export", "play", "pipeline", "adopt", "compare", "compare-video", "demo",
]  # fmt: skip


@pytest.fixture
def data(foreign: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(foreign, tmp_path / "set"))


def places(data: Path) -> dict[str, Path]:
    """Names of places in a data set."""
    link, loop = data.parent / "link", data.parent / "loop"
    link.symlink_to(data / "data")
    loop.symlink_to(data.parent)
    return {
        "equal": data,
        "below": data / "run",
        "deep": data / "a" / "b" / "c",
        "dots": data.parent / "elsewhere" / ".." / data.name / "run",
        "link": link / "run",
        "loop": loop / data.name / "run",
    }


@pytest.mark.parametrize("command", COMMANDS)
def test_nothing_is_written_into_the_data_set_that_is_read(command: str, data: Path) -> None:
    where = places(data)
    before = contents(data.parent)
    for name, place in where.items():
        for key in ("data.root", "data.demos"):
            done = playslot(command, f"{key}={data.parent / 'nothing'},{data}:2", f"out={place}")
            assert done.code == 1, name
            assert_one_line(done.err, command)
            assert f"out={place}: got a place inside the data set {data}, expected a " in done.err
    assert contents(data.parent) == before


@pytest.mark.parametrize("command", ["collect", "pipeline", "demo", "export"])
def test_nothing_is_written_into_another_data_set_either(command: str, data: Path) -> None:
    where = places(data)
    before = contents(data.parent)
    for name, place in where.items():
        if name != "equal":
            done = playslot(command, f"out={place}")
            assert done.code == 1, name
            assert_one_line(done.err, command)
            assert "got a place inside the data set" in done.err
    done = playslot(command, f"out={data.parent / 'new'}", f"data.cache={data / 'cache'}")
    assert f"data.cache={data / 'cache'}: got a place inside the data set" in done.err
    assert contents(data.parent) == before


@pytest.mark.parametrize(
    ("action", "options"),
    [
        ("split", ["--fractions", "a=0.5,b=0.5", "--out"]),
        ("merge", ["--out"]),
        ("repair", ["--out"]),
        ("viz", ["--out"]),
    ],
)
def test_a_data_set_command_writes_outside_of_what_it_reads(action: str, options: list[str], data: Path) -> None:
    where = places(data)
    other = Path(shutil.copytree(data, data.parent / "other"))
    roots = [str(other), str(data)] if action == "merge" else [str(data)]
    before = contents(data.parent)
    for place in where.values():
        done = playslot("dataset", action, *roots, *options, str(place))
        assert done.code == 1
        assert_one_line(done.err, f"dataset {action}")
        assert f"--out {place}: got a place inside the data set {data}, expected a " in done.err
    done = playslot("dataset", "pull", "me/set", str(data / "more"))
    assert "got a place inside the data set" in done.err
    done = playslot("bench", "preset=smoke", "--json", str(data / "bench.json"))
    assert "--json" in done.err
    assert "got a place inside the data set" in done.err
    assert contents(data.parent) == before


def test_a_data_set_within_a_run_is_read(data: Path) -> None:
    """As `pipeline` leaves it: the run holds the data."""
    run = data.parent / "run"
    (run / "data").mkdir(parents=True)
    inner = data.rename(run / "data" / "random")
    done = playslot("train-slots", "preset=smoke", f"data.root={inner}", f"out={run}", "data.camera=nothing", "seed=1")
    assert "nothing" in done.err
    assert "inside" not in done.err


def _arguments(command: str, data: Path, out: str) -> list[str]:
    if command == "dataset split":
        return ["dataset", "split", str(data), "--fractions", "a=0.5,b=0.5", "--out", out]
    if command == "dataset merge":
        return ["dataset", "merge", str(data), str(data.parent / "other"), "--out", out]
    more = (
        ["episodes=1", "workers=1"]
        if command == "collect"
        else [f"data.root={data}", "data.camera=observation.images.top"]
    )
    return [command, "preset=smoke", f"out={out}", "threads=1", "device=cpu", *more]


WRITERS = ["collect", "train-slots", "pipeline", "adopt", "compare", "dataset split", "dataset merge"]


@pytest.mark.parametrize("command", WRITERS)
def test_a_folder_that_cannot_be_is_one_line(command: str, data: Path, tmp_path: Path) -> None:
    shutil.copytree(data, data.parent / "other")
    file = data.parent / "file"
    file.write_text("mine")
    circle = data.parent / "circle"
    circle.symlink_to(circle)
    before = contents(data.parent)
    for out in (
        "/proc/x",
        "/proc/x/y",
        "/sys/x",
        f"{file}/run",
        f"{file}",
        f"{circle}/x",
        f"{data.parent}/{'x' * 256}",
    ):
        done = playslot(*_arguments(command, data, out))
        assert done.code in (1, 2), out
        assert_one_line(done.err, command)
        assert "Traceback" not in done.err
    assert contents(data.parent) == before


@pytest.mark.parametrize("command", ["collect", "train-slots", "dataset split"])
@pytest.mark.parametrize("code", [errno.EACCES, errno.EROFS, errno.EPERM])
def test_a_parent_that_is_read_only_is_one_line(
    command: str, code: int, data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make, closed = os.mkdir, data.parent / "closed"
    closed.mkdir()

    def refuse(path: str | os.PathLike[str], mode: int = 0o777, **more: int | None) -> None:
        if Path(path).is_relative_to(closed):
            raise OSError(code, os.strerror(code), str(path))
        make(path, mode, **more)

    monkeypatch.setattr(os, "mkdir", refuse)
    done = playslot(*_arguments(command, data, f"{closed}/new/run"))
    assert done.code == 1
    assert_one_line(done.err, command)
    assert "expected a writable folder" in done.err
    assert list(closed.iterdir()) == []


@pytest.mark.parametrize(
    ("left", "ours"), [(".config.json.tmp-0", True), (".adopt.json.tmp-1", True), (".x.tmp-0", False)]
)
def test_what_a_kill_in_a_runs_first_file_left_is_nobody_elses(tmp_path: Path, left: str, ours: bool) -> None:
    from playslot_rl.runs.opening import run_to_write

    (tmp_path / left).write_text("{")
    config = compose(["preset=smoke", f"out={tmp_path}"])
    if ours:
        assert run_to_write(config).folder == tmp_path
    else:
        with pytest.raises(OutputError, match="holds something else"):
            run_to_write(config)
