"""Fixtures: data sets that plain LeRobot wrote, one of ours, and copies of them to break."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three episodes of 5, 3 and 7 frames of 32x32 in PNG; look, do not touch."""
    from foreign import write_foreign

    return write_foreign(tmp_path_factory.mktemp("set") / "images", "image")


@pytest.fixture(scope="session")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same in h264, 64x64, two cameras; look, do not touch."""
    from foreign import write_foreign

    return write_foreign(tmp_path_factory.mktemp("set") / "video", "video", size=64, cameras=("top", "side"))


@pytest.fixture(scope="session")
def av1(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same as LeRobot encodes by default; look, do not touch."""
    from foreign import write_foreign

    cameras = ("top", "side")
    return write_foreign(tmp_path_factory.mktemp("set") / "av1", "video", size=64, cameras=cameras, codec="libsvtav1")


@pytest.fixture(scope="session")
def ours(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two random episodes of our own collector, of three agent steps; look, do not touch."""
    from playslot_rl.collectors import collect
    from playslot_rl.config import ExperimentConfig, from_dict

    small = {"env": {"image_size": 32, "warmup_steps": 1}, "render": {"supersample": 1}, "logging": {"progress": False}}
    out = tmp_path_factory.mktemp("set") / "ours"
    return collect(from_dict(ExperimentConfig, small), "random", 2, 3, out, seed=0, workers=1)


@pytest.fixture
def broken(images: Path, tmp_path: Path) -> Path:
    """A copy of `images` to break."""
    return Path(shutil.copytree(images, tmp_path / "broken"))


@pytest.fixture
def broken_video(video: Path, tmp_path: Path) -> Path:
    """A copy of `video` to break."""
    return Path(shutil.copytree(video, tmp_path / "broken"))
