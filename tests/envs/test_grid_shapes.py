"""GridShapes: a clip is a function of its seed, and its labels say what the pixels do."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from playslot_rl.config import EnvConfig, GridConfig
from playslot_rl.envs.grid_shapes import DISPLACEMENTS, MOVES, PALETTE, SHAPES, check_actions, generate, moves_of
from playslot_rl.errors import ConfigError


def settings(objects: int = 2, **grid: float) -> EnvConfig:
    return EnvConfig(name="grid_shapes", grid=GridConfig(objects=objects, **grid), action_dim=2 * objects)  # type: ignore[arg-type]


def test_a_clip_is_a_function_of_its_seed_alone() -> None:
    together, alone = generate([5, 6, 7], 10, settings()), generate([6], 10, settings())
    for field in dataclasses.fields(together):
        np.testing.assert_array_equal(getattr(together, field.name)[1], getattr(alone, field.name)[0])
    assert not np.array_equal(together.frames[0], together.frames[1])


@pytest.mark.parametrize("objects", [1, 2, 5])
def test_shapes_and_ranges(objects: int) -> None:
    clips = generate(range(4), 7, settings(objects))
    assert clips.frames.shape == (4, 8, 64, 64, 3)
    assert clips.frames.dtype == clips.masks.dtype == np.uint8
    assert clips.moves.shape == (4, 7, objects)
    assert clips.actions.shape == (4, 7, 2 * objects)
    assert clips.masks.max() == objects
    assert clips.corners.min() >= 0
    assert clips.corners.max() <= 64 - 15


def test_moves_are_the_displacement_of_the_pixels() -> None:
    clips = generate(range(40), 20, settings(1))
    for clip in range(40):
        rows = [np.argwhere(mask) for mask in clips.masks[clip]]
        centres = np.array([(pixels[:, 1].min(), pixels[:, 0].min()) for pixels in rows])
        np.testing.assert_array_equal(np.diff(centres, axis=0), 2 * DISPLACEMENTS[clips.moves[clip, :, 0]])
        assert len({len(pixels) for pixels in rows}) == 1, "the shape keeps its size"
    assert set(np.unique(clips.moves)) == set(range(len(MOVES)))


def test_names_of_moves_fit_their_displacements() -> None:
    assert dict(zip(MOVES, DISPLACEMENTS.tolist(), strict=True)) == {
        "up": [0, -1],
        "down": [0, 1],
        "left": [-1, 0],
        "right": [1, 0],
        "stay": [0, 0],
    }


def test_a_shape_at_the_border_bounces_and_goes_on_the_other_way() -> None:
    clips = generate(range(60), 60, settings(1, change=0.0))
    bounces = 0
    for corners, moves in zip(clips.corners[:, :, 0], clips.moves[:, :, 0], strict=True):
        for t in np.flatnonzero(np.diff(moves)) + 1:
            bounces += 1
            axis = int(moves[t] in (2, 3))  # moves 2 and 3 are along x
            place = corners[t, 1 - axis]
            assert place < 2 or place > 49 - 2, "without new directions only a border turns a shape"
            assert (DISPLACEMENTS[moves[t]] == -DISPLACEMENTS[moves[t - 1]]).all()
    assert bounces > 40


def test_directions_change_with_their_probability() -> None:
    moves = generate(range(200), 40, settings(1)).moves[:, :, 0]
    changed = float((moves[:, 1:] != moves[:, :-1]).mean())
    assert 0.18 < changed < 0.27, (
        "a quarter of the steps draw a new direction, a fifth of those the old one, plus bounces"
    )


def test_later_objects_occlude_earlier_ones() -> None:
    clips = generate(range(60), 10, settings(2, size=31))
    hidden = 0
    for clip in range(60):
        for t in range(11):
            x, y = clips.corners[clip, t, 1]
            window = clips.masks[clip, t, y : y + 31, x : x + 31]
            full = {0: 709, 1: 512, 2: 961}[int(clips.shapes[clip, 1])]
            hidden += int((clips.masks[clip, t] == 1).sum() < {0: 709, 1: 512, 2: 961}[int(clips.shapes[clip, 0])])
            assert abs(int((window == 2).sum()) - full) <= 64, "nothing is in front of the last object"
            assert (clips.masks[clip, t] == 2).sum() == (window == 2).sum()
    assert hidden > 100


def test_frames_show_the_colours_of_the_masks_and_a_ground_of_its_own() -> None:
    clips = generate(range(80), 3, settings(5))
    for clip in range(80):
        colours = np.concatenate([clips.ground[clip][None], clips.colours[clip]])
        np.testing.assert_array_equal(clips.frames[clip], colours[clips.masks[clip]])
        assert not (clips.colours[clip] == clips.ground[clip]).all(-1).any()
    far = np.abs(PALETTE[:, None].astype(int) - PALETTE[None]).max(-1) + 255 * np.eye(len(PALETTE), dtype=int)
    assert far.min() >= 40, "two colours of the palette look alike"


def test_objects_may_share_a_colour_and_take_all_shapes() -> None:
    clips = generate(range(200), 1, settings(2))
    same = (clips.colours[:, 0] == clips.colours[:, 1]).all(-1)
    assert 5 < same.sum() < 50
    assert set(np.unique(clips.shapes)) == set(range(len(SHAPES)))


def test_starts_are_uniform_over_the_frame() -> None:
    corners = generate(range(1500), 1, settings(1)).corners[:, 0, 0]
    assert corners.min() == 0
    assert corners.max() == 49
    assert np.abs(corners.mean(0) - 24.5).max() < 1.2


def test_actions_give_the_moves_back() -> None:
    clips = generate(range(5), 20, settings(3))
    np.testing.assert_array_equal(moves_of(clips.actions), clips.moves)
    assert set(np.unique(clips.actions)) == {-1.0, 0.0, 1.0}


def test_settings_that_do_not_fit_are_refused_with_the_cure() -> None:
    with pytest.raises(
        ConfigError, match=r"action_dim: got 4, expected 6.*env\.action_dim=6 and model\.savi\.n_slots=4"
    ):
        check_actions(dataclasses.replace(settings(3), action_dim=4))
    with pytest.raises(ConfigError, match="shapes that can move in a frame of 64 pixels"):
        generate([0], 2, settings(1, size=62))
    with pytest.raises(ValueError, match=r"env\.grid\.objects: got 6, expected 1 to 5"):
        GridConfig(objects=6)
