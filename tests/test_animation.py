"""The README's animation and pictures of tasks: small, of the shipped episodes, and drawn again as they are stored."""

from __future__ import annotations

import io
from collections.abc import Callable
from types import ModuleType

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

from playslot_rl.pretrained import episode


@pytest.fixture(scope="module")
def animation(site_module: Callable[[str], ModuleType]) -> ModuleType:
    return site_module("animation")


def frames_of(stored: Image.Image) -> list[npt.NDArray[np.float32]]:
    """RGB frames of an animated picture."""
    frames = []
    for number in range(getattr(stored, "n_frames", 1)):
        stored.seek(number)
        frames.append(np.asarray(stored.convert("RGB"), np.float32))
    return frames


def test_the_animation_is_small_and_as_long_as_its_longest_episode(animation: ModuleType) -> None:
    assert animation.ANIMATION.stat().st_size < 400_000
    with Image.open(animation.ANIMATION) as stored:
        assert len(frames_of(stored)) == max(len(episode(env)) for env in animation.SHOWN)


def test_every_task_of_the_readme_has_its_picture(animation: ModuleType) -> None:
    readme = (animation.ROOT / "README.md").read_text()
    for env in animation.PICTURES:
        assert f"](docs/images/task_{env}.png)" in readme
        with Image.open(animation.ROOT / "docs" / "images" / f"task_{env}.png") as stored:
            assert stored.size == (128, 128)


@pytest.mark.slow
def test_the_animation_is_drawn_again_as_it_is_stored(animation: ModuleType) -> None:
    """After a change of the models, episodes or drawing: `make animation`."""
    with Image.open(animation.ANIMATION) as stored, Image.open(io.BytesIO(animation.draw())) as drawn:
        assert drawn.size == stored.size
        pairs = zip(frames_of(drawn), frames_of(stored), strict=True)
        assert max(np.abs(new - old).mean() for new, old in pairs) < 6.0
