"""Fixtures: one smoke run of the whole pipeline for all tests, and copies of it to break."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from commands import Done, finished_pipeline, run_jobs_here


@pytest.fixture(scope="session")
def pipeline(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> tuple[Path, Done]:
    """The run folder of `pipeline preset=smoke` and what the command said; made once for all of pytest's workers."""
    return finished_pipeline(tmp_path_factory, worker_id)


@pytest.fixture(scope="session")
def shared_run(pipeline: tuple[Path, Done]) -> Path:
    """The finished smoke run; look, do not touch."""
    return pipeline[0]


@pytest.fixture(scope="session")
def videos(shared_run: Path) -> Path:
    """Random episodes."""
    return shared_run / "data" / "random"


@pytest.fixture(scope="session")
def demos(shared_run: Path) -> Path:
    """Demonstrations."""
    return shared_run / "data" / "expert"


@pytest.fixture
def run(shared_run: Path, tmp_path: Path) -> Path:
    """A copy of the finished run to break. Its stored config names the data of the original."""
    skip = shutil.ignore_patterns("figures", "logs")
    return Path(shutil.copytree(shared_run, tmp_path / "run", ignore=skip))


@pytest.fixture
def world(run: Path) -> Path:
    """A copy with a finished world model and no policy."""
    shutil.rmtree(run / "policy")
    return run


@pytest.fixture
def slots_only(world: Path) -> Path:
    """A copy with finished slots and nothing after them."""
    shutil.rmtree(world / "dynamics")
    return world


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Jobs of comparisons run in this process; their names in the order in which they started."""
    return run_jobs_here(monkeypatch)


@pytest.fixture(scope="session")
def foreign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set that is not ours: two cameras of 64x64, actions of width 2, no seeds."""
    from foreign import write_foreign

    return write_foreign(tmp_path_factory.mktemp("foreign") / "set", "image", size=64, cameras=("top", "side"))
