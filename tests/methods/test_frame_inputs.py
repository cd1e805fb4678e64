"""Frames as inputs of a regression: the right rows, shifted as drawn."""

from __future__ import annotations

import numpy as np
import torch
from clips import moving_square

from playslot_rl.data.views import shift_frames
from playslot_rl.seeds.draws import StepGenerators
from playslot_rl.training.stage_regression import FrameInputs


def test_rows_are_those_of_the_data_set() -> None:
    source = moving_square()
    inputs = FrameInputs(source, np.array([3, 7, 11]), "cpu")
    got = inputs.plain(torch.tensor([2, 0]))
    assert got.dtype == torch.uint8
    np.testing.assert_array_equal(got.movedim(1, -1).numpy(), source.frames[[11, 3]])


def test_a_shift_moves_the_inside_and_repeats_the_edge() -> None:
    frames = np.random.default_rng(0).integers(256, size=(3, 8, 8, 3), dtype=np.uint8)
    moved = shift_frames(frames, [[0, 0], [2, 0], [-1, 3]])
    assert np.array_equal(moved[0], frames[0])
    assert np.array_equal(moved[1, 2:], frames[1, :-2])
    assert np.array_equal(moved[1, 0], frames[1, 0])
    assert np.array_equal(moved[1, 1], frames[1, 0])
    assert np.array_equal(moved[2, :-1, 3:], frames[2, 1:, :-3])


def test_shifts_are_drawn_anew_each_step_and_repeat_with_the_seed() -> None:
    inputs = FrameInputs(moving_square(), np.arange(20), "cpu", shift=3)
    rows = torch.arange(8)
    first = inputs.draw(rows, StepGenerators(0, 1))
    assert torch.equal(first, inputs.draw(rows, StepGenerators(0, 1)))
    assert not torch.equal(first, inputs.draw(rows, StepGenerators(0, 2)))
    assert not torch.equal(first, inputs.plain(rows))
