"""Atomic writes."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from playslot_rl.errors import OutputError, explain
from playslot_rl.storage.atomic import explain_write_errors, lock, replace_dir, write_bytes, write_json, write_text


def test_a_failed_write_leaves_the_old_content_and_no_temporary(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "file.txt"
    write_text(path, "old")

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OutputError, match="the disk is full") as caught:
        write_bytes(path, b"new")
    assert "\n" not in str(caught.value)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_what_a_killed_writer_left_is_written_over(tmp_path: Path) -> None:
    (tmp_path / ".file.txt.tmp-0").write_text("half of something longer")
    write_text(tmp_path / "file.txt", "whole")
    assert (tmp_path / "file.txt").read_text() == "whole"
    assert [path.name for path in tmp_path.iterdir()] == ["file.txt"]


def test_what_another_process_is_writing_is_left_to_it(tmp_path: Path) -> None:
    with (tmp_path / ".file.txt.tmp-0").open("w") as others:
        assert lock(others.fileno())
        others.write("theirs")
        write_text(tmp_path / "file.txt", "ours")
    assert (tmp_path / "file.txt").read_text() == "ours"
    assert (tmp_path / ".file.txt.tmp-0").read_text() == "theirs"
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize(
    ("number", "line"),
    [
        (errno.ENOSPC, "got a full disk for /data/x, expected free space"),
        (errno.EDQUOT, "got a used-up disk quota for /data/x, expected free space"),
        (errno.EROFS, "got a read-only file system for /data/x, expected one that can be written"),
        (errno.EACCES, "got no permission for /data/x, expected it"),
        (errno.EMFILE, "got too many open files for /data/x, expected a higher limit"),
        (errno.ENFILE, "got too many open files for /data/x on this machine, expected fewer"),
    ],
)
@pytest.mark.parametrize("wrapped", [False, True])
def test_what_the_system_refuses_is_one_line_whoever_ran_into_it(number: int, line: str, wrapped: bool) -> None:
    refused = OSError(number, os.strerror(number), "/data/x")
    error: Exception = refused
    if wrapped:
        error = RuntimeError("a library's own words")
        error.__cause__ = refused
    assert explain(error).startswith(line)


def test_json_refuses_numbers_it_cannot_hold(tmp_path: Path) -> None:
    with pytest.raises(ValueError):
        write_json(tmp_path / "x.json", {"loss": float("nan")})
    assert list(tmp_path.iterdir()) == []


def test_a_folder_is_replaced_as_a_whole(tmp_path: Path) -> None:
    for name, text in (("new", "new"), ("final", "old")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a.txt").write_text(text)
    (tmp_path / "final" / "stale.txt").write_text("stale")
    replace_dir(tmp_path / "new", tmp_path / "final")
    assert [path.name for path in tmp_path.rglob("*")] == ["final", "a.txt"]
    assert (tmp_path / "final" / "a.txt").read_text() == "new"


def test_a_file_in_the_way_is_explained(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(OutputError, match="a file stands where a folder is needed"):
        write_text(tmp_path / "file" / "x.txt", "text")


def test_other_errors_pass_through(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), explain_write_errors(tmp_path):
        (tmp_path / "missing").read_text()
