"""Fixtures: a server of children, and a finished run to copy from."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from children import Children
from commands import finished_pipeline
from lab import Lab
from table import TABLE


@pytest.fixture(scope="session")
def children(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Children]:
    """Run commands."""
    server = Children(tmp_path_factory.mktemp("children"))
    yield server
    server.close()


@pytest.fixture(scope="session")
def lab(children: Children, tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Callable[..., Lab]:
    """A row of the table that has run once, undisturbed; its tests share a folder, unless they name one."""
    known: dict[str, Lab] = {}

    def open_lab(name: str, root: Path | None = None) -> Lab:
        if root is None and name in known:
            return known[name]
        finished = finished_pipeline(tmp_path_factory, worker_id)[0]
        made = Lab(TABLE[name], children, finished, root or tmp_path_factory.mktemp("lab") / "work")
        made.undisturbed()
        if root is None:
            known[name] = made
        return made

    return open_lab
