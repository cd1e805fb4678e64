"""Settings of every test: an off-screen GL backend, one compute thread, caches in a temporary folder."""

from __future__ import annotations

import copy
import gc
import os
import re
import signal
from collections.abc import Callable, Iterator
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

# Before torch and mujoco are imported: both read their variable once.
os.environ.setdefault("MUJOCO_GL", "egl")
os.environ.setdefault("OMP_NUM_THREADS", "1")
# No test may reach the Hub: a missing local data set must fail at once.
os.environ.setdefault("HF_HUB_OFFLINE", "1")
# A shell starts its background jobs with Ctrl-C ignored, and Python then leaves it so; tests of Ctrl-C send it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

REPOSITORY = Path(__file__).resolve().parents[1]
LONGEST = (
    "recipes/test_baselines.py",
    "recipes/test_compare_video.py",
    "methods/test_contract.py",
    "methods/test_what_rows_see.py",
    "recipes/test_robot_actions.py",
    "recipes/test_robot_errors.py",
    "faults/test_every_command.py",
    "training/test_several_processes.py",
    "recipes/test_several_processes.py",
    "test_docs_site.py",
    "test_docs_python.py",
    "golden/test_identities.py",
    "recipes/test_compare.py",
    "hub/test_circle.py",
)
"""Files that take longest. They begin: no worker is left alone with one of them at the end."""
TOGETHER = ("tests/hub/",)
"""Folders whose files go to one worker: they share processes that import for ten seconds and more."""


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out files of which the marker expression takes no test: to import them takes longer than many a test."""
    if not collection_path.name.startswith("test_") or collection_path.suffix != ".py":
        return None
    text, wanted = collection_path.read_text(), config.option.markexpr
    for tier in ("integration", "slow", "browser", "gpu"):
        whole, part = re.search(rf"^pytestmark = (\[\s*)?pytest\.mark\.{tier}\b", text, re.M), f"mark.{tier}" in text
        if (f"not {tier}" in wanted and whole) or (wanted.startswith(tier) and not part):
            return True
    return None


gc.disable()  # while a million objects are imported; they stay, and are not looked through again afterwards


def pytest_collection_finish() -> None:
    """Collect garbage from here on."""
    gc.freeze()
    gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest files first (files go to pytest's workers in this order)."""
    first = {REPOSITORY / "tests" / name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: first.get(item.path, len(LONGEST)))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Of --dist loadfile, but the files of some folders stay together."""
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return next((folder for folder in TOGETHER if nodeid.startswith(folder)), super()._split_scope(nodeid))

    return Scheduling(config, log) if config.getoption("dist") == "loadfile" else None


@pytest.fixture(scope="session", autouse=True)
def _caches_in_a_temporary_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PLAYSLOT_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session", autouse=True)
def _no_waiting_for_the_disk() -> Iterator[None]:
    """Tests kill processes, never the machine: what was written survives them without an fsync, which is dear."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)
        yield


@pytest.fixture(scope="session", autouse=True)
def _models_compiled_once() -> Iterator[None]:
    """Meta-World compiles its XML for every environment, a fifth of a second; here from the second on it is a copy."""
    import mujoco

    compiled, models = mujoco.MjModel.from_xml_path, dict[str, mujoco.MjModel]()

    def once(filename: str, assets: object = None) -> mujoco.MjModel:
        if assets is not None:
            return compiled(filename, assets)
        if filename not in models:
            models[filename] = compiled(filename)
        return copy.copy(models[filename])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mujoco.MjModel, "from_xml_path", once)
        yield


@pytest.fixture(scope="module")
def thin_resnets() -> Iterator[None]:
    """ResNet-18 is thin: for trainings that promise nothing of its size."""
    import torchvision
    from thin import thin_resnet18

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torchvision.models, "resnet18", thin_resnet18)
        yield


@pytest.fixture(scope="session")
def repository() -> Path:
    """Root of the repository."""
    return REPOSITORY


@pytest.fixture(scope="session")
def site_module(repository: Path) -> Callable[[str], ModuleType]:
    """A program of docs/_site by its name, imported."""

    def imported(name: str) -> ModuleType:
        spec = spec_from_file_location(name, repository / "docs" / "_site" / f"{name}.py")
        assert spec is not None
        assert spec.loader is not None
        module = module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    return imported
