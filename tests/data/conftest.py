"""Fixtures: data sets that are not ours."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from foreign import write_foreign


@pytest.fixture(scope="session")
def foreign_images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_foreign(tmp_path_factory.mktemp("foreign") / "images", "image")


@pytest.fixture(scope="session")
def foreign_video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_foreign(tmp_path_factory.mktemp("foreign") / "video", "video", size=64, cameras=("top", "side"))


@pytest.fixture
def damaged(foreign_images: Path, tmp_path: Path) -> Path:
    """A copy to break."""
    return Path(shutil.copytree(foreign_images, tmp_path / "damaged"))


@pytest.fixture(autouse=True)
def no_hub(monkeypatch: pytest.MonkeyPatch) -> None:
    """A missing root must never become a request to the Hub."""
    import huggingface_hub

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("a request to the Hub was made")

    monkeypatch.setattr(huggingface_hub, "snapshot_download", refuse)
