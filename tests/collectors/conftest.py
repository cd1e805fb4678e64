"""Fixtures: a journal recorded without faults."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from small_sets import spec_of

from playslot_rl.collectors.episodes import record
from playslot_rl.collectors.journal import Journal


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A journal of three episodes, recorded in this process without faults."""
    folder = tmp_path_factory.mktemp("recorded") / "data.journal"
    journal = Journal(folder, spec_of(3))
    for episode in record(journal.spec, range(3)):
        journal.add(episode)
    return folder


@pytest.fixture(scope="module")
def reference(recorded: Path) -> list[Any]:
    """PNGs of the first three episodes."""
    journal = Journal(recorded, spec_of(3))
    return [journal.read_with_images(index)[1] for index in range(3)]
