"""Looking at a data set: how far things move, and what follows from it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from playslot_rl.datasets.survey import FAR, KEPT, Survey, choose_size, choose_stride, survey, typical_motion
from playslot_rl.errors import DataError

Frames = npt.NDArray[np.uint8]


def moving_blob(speed: float, frames: int = 60, side: int = 64, width: float = 4.0, noise: float = 0.0) -> Frames:
    """A bright soft disc that moves to the right by `speed` pixels a frame over a dark ground."""
    down, right = np.mgrid[:side, :side]
    generator = np.random.default_rng(0)
    made = []
    for t in range(frames):
        blob = 200 * np.exp(-((right - 8 - speed * t) ** 2 + (down - side / 2) ** 2) / (2 * width**2)) + 20
        made.append(np.repeat(blob[..., None], 3, axis=-1) + noise * generator.normal(size=(side, side, 3)))
    return np.clip(np.stack(made), 0, 255).astype(np.uint8)


def seen(frames: Frames, size: tuple[int, int] = (64, 64), noise: float = 0.0) -> Survey:
    lengths = np.full(5, len(frames), np.int64)
    return Survey(Path("set"), "top", 20.0, size, lengths, 0, [frames], noise)


@pytest.mark.parametrize("speed", [0.5, 1.0, 2.0])
def test_motion_is_measured_in_pixels(speed: float) -> None:
    assert typical_motion([moving_blob(speed, 24)], 1, 2.0) == pytest.approx(speed, rel=0.35)


@pytest.mark.parametrize(("speed", "expected"), [(2.0, 1), (0.34, 4), (0.6, 2)])
def test_the_stride_makes_things_move_by_a_pixel(speed: float, expected: int) -> None:
    stride, reason = choose_stride(seen(moving_blob(speed)), 64)
    assert abs(stride - expected) <= 1, reason
    assert "frames a second are left" in reason


def test_a_stride_leaves_frames_enough_and_says_what_that_costs() -> None:
    stride, reason = choose_stride(seen(moving_blob(0.15, frames=2 * KEPT)), 64)
    assert stride == 2
    assert f"less than {FAR:g}" in reason


def test_camera_noise_is_no_motion() -> None:
    still = moving_blob(0.0, 10, noise=6.0)
    assert typical_motion([still], 1, 10.0) > 0
    assert typical_motion([still], 1, replace(seen(still), noise=6.0).threshold) == 0


def test_small_motion_asks_for_larger_frames_where_the_camera_has_them() -> None:
    small, large = moving_blob(1.0, 60, 128, width=0.8), moving_blob(1.0, 60, 128, width=10.0)
    assert choose_size(seen(small, (480, 640)))[0] == 128
    assert choose_size(seen(large, (480, 640)))[0] == 64
    assert choose_size(seen(small, (96, 128)))[0] == 64  # more would be invented
    assert choose_size(seen(small, (48, 64)))[0] == 32


def test_long_episodes_of_which_only_the_beginning_is_read_move_as_well() -> None:
    long = replace(seen(moving_blob(0.2, 60, 128, width=10.0), (480, 640)), lengths=np.full(5, 3000, np.int64))
    value, reason = choose_size(long)
    assert value == 64, reason


def test_a_data_set_is_looked_at_without_reading_all_of_it(video: Path) -> None:
    found = survey(video, "observation.images.side")
    assert (found.fps, found.size, found.action_dim, found.lengths.tolist()) == (10.0, (64, 64), 2, [5, 3, 7])
    assert [frames.shape for frames in found.episodes] == [(n, 64, 64, 3) for n in (5, 3, 7)]
    with pytest.raises(DataError, match=r"got 2 cameras .* set data\.camera="):
        survey(video)
