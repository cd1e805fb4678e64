"""Every writing command, killed, out of space, forbidden to write, short of files, or typed twice at once.

It says what is wrong in one line, leaves nothing half-made that is taken for whole, and the same command, typed again,
ends with the same files, byte for byte.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from children import KILLED
from lab import Lab, assert_one_line
from table import NOT_HERE, TABLE
from tiny_disk import tiny_disk

from playslot_rl import cli
from playslot_rl.recipes import cache, dataset

Open = Callable[..., Lab]


def of_every_row(test: Callable[..., None]) -> Callable[..., None]:
    """A slow test of each command."""
    return pytest.mark.slow(pytest.mark.timeout(3000)(pytest.mark.parametrize("name", TABLE)(test)))


def test_every_writing_command_is_in_the_table() -> None:
    typed = {" ".join(row.argv[: 1 + (row.argv[0] in cli.GROUPS)]) for row in TABLE.values()}
    groups = {
        f"{name} {action}" for name, group in (("dataset", dataset), ("cache", cache)) for action in group.ACTIONS
    }
    assert typed | NOT_HERE.keys() == {*cli.COMMANDS, *groups}
    assert not typed & NOT_HERE.keys()


@of_every_row
def test_killed_at_each_kind_of_write_the_same_command_carries_on(lab: Open, name: str) -> None:
    made = lab(name)
    for said, point in made.points()[: 5 if TABLE[name].heavy else None]:
        made.lay()
        assert made.run(kill=point).code == KILLED, said
        made.carries_on(said, may_be_done=point == "end")


@of_every_row
def test_a_disk_that_is_full_from_some_write_on_is_one_line(lab: Open, name: str) -> None:
    made = lab(name)
    places = [number for number, (kind, _) in enumerate(made.writes) if kind == "made"]
    middle = places[len(places) // 2]
    for number in (middle,) if TABLE[name].heavy else sorted({places[0], middle, places[-1]}):
        said = f"full at {made.writes[number]}"
        made.lay()
        made.refuses_or_ends(said, fail=number, errno=errno.ENOSPC)


@of_every_row
def test_a_disk_that_fills_while_a_command_writes_is_one_line(lab: Open, name: str, tmp_path: Path) -> None:
    """A real one: also what libraries write without Python runs into it."""
    with tiny_disk(tmp_path / "disk", 256 * 1024) as disk:
        made = lab(name, disk / "work")
        for share in (0.5,) if TABLE[name].heavy else (0.2, 0.9):
            made.lay()
            room = int(max(0, made.size) * share)
            (disk / "ballast").write_bytes(bytes(max(0, _free(disk) - room)))
            made.refuses_or_ends(f"{share:.0%} of the room", after=(disk / "ballast").unlink)


def _free(disk: Path) -> int:
    found = os.statvfs(disk)
    return found.f_bavail * found.f_frsize


@of_every_row
def test_folders_that_may_not_be_written_are_one_line(lab: Open, name: str) -> None:
    made = lab(name)
    made.lay()
    folders = [made.root, *(path for path in made.root.rglob("*") if path.is_dir())]

    def allow(mode: int = 0o755) -> None:
        for folder in folders:
            folder.chmod(mode)

    allow(0o555)
    made.refuses_or_ends("read-only", after=allow, mortal=True)


@of_every_row
def test_few_open_files_are_enough_or_one_line(lab: Open, name: str) -> None:
    made = lab(name)
    for limit in (10,) if TABLE[name].heavy else (7, 16):
        made.lay()
        made.refuses_or_ends(f"{limit} files", descriptors=limit)


@of_every_row
def test_typed_twice_at_once_both_end_or_one_is_refused(lab: Open, name: str) -> None:
    made = lab(name)
    made.lay()
    both = [made.children.start(made.root, *TABLE[name].argv, again=number) for number in range(2)]
    ended = [child.wait() for child in both]
    for one in ended:
        if one.code:
            assert_one_line(one)
    assert 0 in [one.code for one in ended], ended
    made.assert_whole("twice")
