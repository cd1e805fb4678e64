"""The Ray backend: a local cluster of two workers records what this process would, also when a worker is killed."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from playslot_rl.collectors.episodes import record
from playslot_rl.collectors.journal import ARRAYS, CollectionSpec, Journal
from playslot_rl.collectors.recording import record_into
from playslot_rl.config import CollectorConfig, ExperimentConfig, from_dict
from playslot_rl.errors import PlaySlotError

EPISODES, STEPS = 12, 3
SMALL: dict[str, Any] = {"env": {"image_size": 32, "warmup_steps": 1}, "render": {"supersample": 1}}


def spec_of(episodes: int) -> CollectionSpec:
    return CollectionSpec.make(from_dict(ExperimentConfig, SMALL), "expert", episodes, STEPS, 0)


def stats() -> dict[int, list[str]]:
    """Fields of /proc/PID/stat from the state on, of every process that is no zombie."""
    found = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rsplit(")", 1)[1].split()
        except OSError:
            continue
        if fields[0] != "Z":
            found[int(path.parent.name)] = fields
    return found


def descendants(pid: int) -> list[int]:
    parents = {child: int(fields[1]) for child, fields in stats().items()}
    found, level = [], [pid]
    while level:
        level = [child for child, parent in parents.items() if parent in level]
        found += level
    return found


def actors() -> list[int]:
    """Processes of the workers that this process's cluster runs."""
    named = []
    for pid in descendants(os.getpid()):
        try:
            if b"ray::Body" in Path(f"/proc/{pid}/cmdline").read_bytes():
                named.append(pid)
        except OSError:
            continue
    return named


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_two_ray_workers_record_the_local_episodes_and_a_killed_one_is_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    before = set(descendants(os.getpid()))
    journal, said = Journal(tmp_path / "ray", spec_of(EPISODES)), []
    stored, killed = [], 0
    for index in record_into(journal, range(EPISODES), 2, CollectorConfig(backend="ray"), said.append):
        stored.append(index)
        if not killed:
            killed = actors()[0]
            os.kill(killed, signal.SIGKILL)
    assert sorted(stored) == list(range(EPISODES))
    assert journal.missing() == []
    assert len(said) == 1
    assert "another takes its place" in said[0]

    deadline = time.monotonic() + 30
    while (left := set(descendants(os.getpid())) - before) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not left  # the cluster was ours, and is gone

    local = Journal(tmp_path / "local", spec_of(4))
    for episode in record(local.spec, range(4)):
        local.add(episode)
    for index in range(4):
        (ours, our_images), (theirs, their_images) = (j.read_with_images(index) for j in (journal, local))
        assert our_images == their_images
        assert (ours.index, ours.seed, ours.redrawn) == (theirs.index, theirs.seed, theirs.redrawn)
        for name in ARRAYS:
            np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))


def test_a_cluster_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    settings = CollectorConfig(backend="ray", ray_address="127.0.0.1:1")
    with pytest.raises(PlaySlotError, match=r"127\.0\.0\.1:1.*check collector\.ray_address"):
        list(record_into(Journal(tmp_path / "j", spec_of(2)), range(2), 2, settings))
