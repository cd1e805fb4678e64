"""Grids, animations and the pictures of slots and prototypes."""

from __future__ import annotations

import io

import numpy as np
import pytest
import torch
from PIL import Image

from playslot_rl.frames import to_float
from playslot_rl.testing import tiny_config
from playslot_rl.visualization.drawings import change_map, draw_prototypes, prototype_frames, segmentation, slot_cells
from playslot_rl.visualization.grid import GAP, animation, image_grid, side_by_side
from playslot_rl.world_model import WorldModel

RNG = np.random.default_rng(0)


def _frames(*shape: int) -> np.ndarray:
    return RNG.integers(0, 256, (*shape, 3), dtype=np.uint8)


def _model(mode: str = "hybrid", multi: bool = False) -> WorldModel:
    config = tiny_config(mode=mode, multi=multi)  # type: ignore[arg-type]
    torch.manual_seed(0)
    model = WorldModel(config.model, config.env).train()
    if mode == "hybrid":
        model.inverse_dynamics(torch.randn(4, 9, 4, 32))  # fills the codebook
    return model.eval()


def test_pixels_survive_the_grid_unchanged() -> None:
    cells = _frames(2, 3, 4, 5)
    picture = np.asarray(image_grid(cells, scale=1))
    assert picture.shape == (2 * 4 + GAP, 3 * 5 + 2 * GAP, 4)
    np.testing.assert_array_equal(picture[4 + GAP : 8 + GAP, 5 + GAP : 10 + GAP, :3], cells[1, 1])
    assert picture[4 + 1, 0, 3] == 0  # the gap is transparent


def test_grid_refuses_a_wrong_number_of_labels() -> None:
    with pytest.raises(ValueError, match="1 row and 0 column labels, expected 2 and 3"):
        image_grid(_frames(2, 3, 4, 5), ["one"])


def test_animation_plays_all_its_pictures() -> None:
    clips = _frames(2, 2, 5, 8, 8)
    pictures = side_by_side(clips, ("a", "b"), ["1", "2"])
    played = Image.open(io.BytesIO(animation(pictures, fps=10)))
    assert played.n_frames == 5  # type: ignore[attr-defined]
    played.seek(3)
    np.testing.assert_array_equal(np.asarray(played.convert("RGBA")), np.asarray(pictures[3]))
    with pytest.raises(ValueError, match="animation: got 0 frames"):
        animation([])


def test_slot_objects_on_white_add_up_to_the_reconstruction() -> None:
    model = _model()
    frames = _frames(3, 64, 64)
    cells = slot_cells(model, frames)
    assert cells.shape == (3 + 4, 3, 64, 64, 3)
    np.testing.assert_array_equal(cells[0], frames)
    # With rgb inside [0, 1]: sum of (rgb * m + 1 - m) = frame + N - 1.
    with torch.no_grad():
        decoded = model.savi.decode(model.savi(to_float(frames)[None])[0][0])
        inside = ((decoded.rgb >= 0) & (decoded.rgb <= 1)).all(1).movedim(1, -1).numpy()
    total = cells[3:].astype(int).sum(0) - 3 * 255
    assert np.abs(total - cells[1])[inside].max() <= 3


def test_segmentation_follows_the_largest_mask() -> None:
    masks = np.zeros((1, 2, 1, 4, 4), np.float32)
    masks[:, 0, :, :2], masks[:, 1, :, 2:] = 1, 1
    colours = segmentation(np.full((1, 4, 4, 3), 100, np.uint8), masks)[0]
    assert (colours[:2] == colours[0, 0]).all()
    assert (colours[2:] == colours[3, 3]).all()
    assert (colours[0, 0] != colours[3, 3]).any()


@pytest.mark.parametrize("multi", [False, True])
def test_each_prototype_is_held_for_all_steps(multi: bool) -> None:
    model = _model(multi=multi)
    frames = prototype_frames(model, _frames(64, 64), steps=10)  # past the predictor's context of 8
    assert frames.shape == (5, 10, 64, 64, 3)
    assert any((frames[0] != frames[k]).any() for k in range(1, 5))
    assert draw_prototypes(model, _frames(64, 64), steps=3).width > 5 * 128


def test_a_mode_without_prototypes_is_refused() -> None:
    with pytest.raises(ValueError, match="got latent-action mode continuous"):
        prototype_frames(_model("continuous"), _frames(64, 64))


def test_change_map_is_white_where_nothing_moved() -> None:
    before = np.full((1, 4, 4, 3), 100, np.uint8)
    after = before.copy()
    after[0, 0, 0], after[0, 1, 1] = 200, 0
    change = change_map(before, after)[0]
    assert (change[3] == 255).all()
    assert change[0, 0, 0] > change[0, 0, 2]  # brighter: orange
    assert change[1, 1, 2] > change[1, 1, 0]  # darker: blue
