"""New folders appear whole or not at all; a lock keeps others out, and waits or refuses as asked."""

from __future__ import annotations

import errno
import multiprocessing
import subprocess
import sys
import time
from pathlib import Path

import pytest

from playslot_rl.errors import OutputError
from playslot_rl.storage.folders import new_folder
from playslot_rl.storage.locks import locked


@pytest.mark.parametrize("name", ["made", "k[1]", "a*"])
def test_a_folder_appears_whole_and_leftovers_of_a_kill_go(tmp_path: Path, name: str) -> None:
    final = tmp_path / "deep" / name
    (final.parent / f".{name}.tmp-0123456789ab").mkdir(parents=True)
    with new_folder(final) as temporary:
        (temporary / "file").write_text("whole")
        assert not final.exists()
    assert (final / "file").read_text() == "whole"
    assert [entry.name for entry in final.parent.iterdir()] == [name]


def test_two_that_make_one_folder_leave_each_other_alone(tmp_path: Path) -> None:
    final = tmp_path / "made"

    def second() -> None:
        with new_folder(final) as temporary:
            (temporary / "file").write_text("second")
            with new_folder(final) as other:
                (other / "file").write_text("first")

    with pytest.raises(OutputError, match="is there already, expected none; choose another out="):
        second()
    assert (final / "file").read_text() == "first"
    assert [entry.name for entry in tmp_path.iterdir()] == ["made"]


def test_an_error_leaves_nothing_and_keeps_what_was_there(tmp_path: Path) -> None:
    final = tmp_path / "made"
    final.mkdir()
    (final / "old").touch()

    def fail() -> None:
        with new_folder(final, replace=True) as temporary:
            (temporary / "new").touch()
            raise RuntimeError("half way")

    with pytest.raises(RuntimeError, match="half way"):
        fail()
    assert [entry.name for entry in tmp_path.rglob("*")] == ["made", "old"]


def test_something_that_is_there_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="is there already, expected none; choose another out="), new_folder(tmp_path):
        raise AssertionError("not reached")
    (tmp_path / "empty").mkdir()
    with new_folder(tmp_path / "empty", create=False) as temporary:
        assert not temporary.exists()
        temporary.mkdir()
        (temporary / "file").touch()
    assert (tmp_path / "empty" / "file").is_file()


def test_a_lock_that_another_process_holds_is_refused_until_it_ends(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    code = (
        "import sys; from pathlib import Path; from playslot_rl.storage.locks import locked\n"
        "with locked(Path(sys.argv[1])): print('held', flush=True); sys.stdin.read()"
    )
    holder = subprocess.Popen(
        [sys.executable, "-c", code, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert holder.stdout is not None
    assert holder.stdout.readline() == "held\n"
    with pytest.raises(OutputError, match="wait for it"), locked(path, "got another process, wait for it"):
        raise AssertionError("not reached")
    holder.kill()
    holder.wait()
    with locked(path, "got another process, wait for it"), locked(tmp_path / "other"):
        pass


@pytest.mark.parametrize("code", [errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS])
def test_without_locks_nobody_is_kept_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int) -> None:
    def flock(*_: object) -> None:
        raise OSError(code, "no locks")

    monkeypatch.setattr("fcntl.flock", flock)
    path = tmp_path / "lock"
    path.write_text("12345\nanother machine\n")  # as a killed process of another version leaves it
    with locked(path, "got another process, wait for it"):
        pass


def test_a_lock_that_is_given_back_stays_with_no_child(tmp_path: Path) -> None:
    with locked(tmp_path / "lock"):
        child = multiprocessing.get_context("fork").Process(target=time.sleep, args=(30,))
        child.start()
    try:
        with locked(tmp_path / "lock", "got another process, wait for it"):
            pass
    finally:
        child.kill()
        child.join()
