"""Magnified clips."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from playslot_rl.data.zoom import corners, magnified


@pytest.mark.parametrize("zoom", [1.0, 1.5, 2.0, 3.0, 8.0])
def test_a_magnified_pixel_is_the_one_it_was_cut_from(zoom: float) -> None:
    size = 24
    frames = torch.arange(2 * 3 * 3 * size * size).view(2, 3, 3, size, size).float()
    at = corners(2, size, zoom, np.random.default_rng(0))
    out, side = magnified(frames, zoom, at), round(size / zoom)
    assert out.shape == frames.shape
    for b, (y, x) in enumerate(at.tolist()):
        for i, j in [(0, 0), (size - 1, size - 1), (5, 17)]:
            expected = frames[b, :, :, y + i * side // size, x + j * side // size]
            assert torch.equal(out[b, :, :, i, j], expected)


def test_all_frames_of_a_clip_show_the_same_square_and_clips_others() -> None:
    frames = torch.arange(64 * 64, dtype=torch.float32).view(1, 1, 1, 64, 64).expand(8, 4, 3, 64, 64)
    out = magnified(frames, 2.0, corners(8, 64, 2.0, np.random.default_rng(1)))
    assert torch.equal(out, out[:, :1].expand_as(out))
    assert len({float(clip[0, 0, 0, 0]) for clip in out}) > 4


def test_squares_lie_anywhere_inside_the_frame_and_a_zoom_of_one_changes_nothing() -> None:
    at = corners(4000, 64, 2.0, np.random.default_rng(2))
    assert at.min() == 0
    assert at.max() == 32
    assert len(np.unique(at[:, 0])) == 33
    frames = torch.randint(256, (2, 3, 3, 64, 64), dtype=torch.uint8)
    assert torch.equal(magnified(frames, 1.0, corners(2, 64, 1.0, np.random.default_rng(3))), frames)
