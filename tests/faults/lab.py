"""A place to run a row of the table in, undisturbed and disturbed, and to compare what it leaves."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from children import Children, Ended
from faultiness import WRITES
from table import Row

from results import contents


@dataclass
class Lab:
    """One row.

    Args:
        row: the command.
        children: run it.
        finished: a finished smoke run.
        root: the work folder; the same for all runs, as it is part of what they write.

    Attributes:
        whole: what an undisturbed run leaves.
        size: bytes of what it made.
        writes: what it did, in order.
    """

    row: Row
    children: Children
    finished: Path
    root: Path
    whole: dict[str, str] = field(default_factory=dict)
    size: int = 0
    writes: list[tuple[str, str]] = field(default_factory=list)

    def undisturbed(self) -> None:
        """Run it once, for what it leaves and for its writes."""
        self.lay()
        before = _bytes(self.root)
        child = self.children.start(self.root, *self.row.argv)
        ended = child.wait()
        assert ended.code == 0, ended.err
        self.whole, self.size = contents(self.root, self.row.passing), _bytes(self.root) - before
        self.writes = json.loads((child.place / WRITES).read_text())

    def lay(self) -> None:
        """The work folder as it was before."""
        self.row.lay(self.root, self.finished)

    def run(self, **fault: Any) -> Ended:
        """The command."""
        return self.children.run(self.root, *self.row.argv, **fault)

    def carries_on(self, what: object, *, may_be_done: bool = False) -> None:
        """The same command, typed again, ends with what an undisturbed one leaves."""
        again = self.run(again=True)
        if again.code and may_be_done and self.row.done:
            assert_one_line(again)
            assert self.row.done in again.err, (what, again.err)
        else:
            assert again.code == 0, (what, again.err)
        self.assert_whole(what)

    def refuses_or_ends(self, what: object, after: Callable[[], object] = lambda: None, **fault: Any) -> None:
        """A fault is one line, or none; without it (`after` takes it away) the same command carries on."""
        try:
            ended = self.run(fault=True, **fault)
        finally:
            after()
        if ended.code:
            assert_one_line(ended)
        self.carries_on(what, may_be_done=not ended.code)

    def assert_whole(self, what: object) -> None:
        """Everything is there, and nothing else."""
        found = contents(self.root, self.row.passing)
        if self.row.clocked:
            assert not [name for name in found if ".tmp-" in name or name.endswith(".journal")], what
            return
        wrong = {name for name in found.keys() | self.whole.keys() if found.get(name) != self.whole.get(name)}
        assert not wrong, (what, {name: (self.whole.get(name), found.get(name)) for name in sorted(wrong)})

    def points(self) -> list[tuple[str, int | str]]:
        """Where it is killed: before the first and the last, and after the middle write of each kind; at the end."""
        found: dict[int | str, str] = {"end": "after everything"}
        for kind in ("renamed", "made", "removed"):
            places = [number for number, (other, _) in enumerate(self.writes) if other == kind]
            if places:
                middle = places[len(places) // 2]
                for number, when in ((places[-1], "before"), (middle + 1, "after"), (places[0], "before")):
                    write = self.writes[number - (when == "after")]
                    if number < len(self.writes):
                        found.setdefault(number, f"{when} {kind}: {write[1]}")
        return [(said, number) for number, said in found.items()]


def _bytes(root: Path) -> int:
    return sum(path.stat().st_size for path in root.rglob("*") if path.is_file())


def assert_one_line(ended: Ended) -> None:
    """An error that somebody thought of."""
    assert ended.code in (1, 2), ended
    assert ended.err.count("\n") == 1, ended.err
    assert ": error: " in ended.err, ended.err
    assert "unexpected" not in ended.err, ended.err
