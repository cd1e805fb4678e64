"""Every byte survives the way to numbers and back, in both layouts."""

from __future__ import annotations

import numpy as np
import torch

from playslot_rl.frames import normalise, quantise, to_float, to_uint8


def test_every_byte_is_its_255th_and_comes_back() -> None:
    bytes_ = torch.arange(256, dtype=torch.uint8)
    numbers = normalise(bytes_)
    torch.testing.assert_close(numbers, torch.arange(256) / 255)
    assert torch.equal(quantise(numbers), bytes_)


def test_what_is_in_its_form_already_passes_through() -> None:
    numbers, bytes_ = torch.rand(3), torch.arange(3, dtype=torch.uint8)
    assert normalise(numbers) is numbers
    assert quantise(bytes_) is bytes_


def test_numbers_outside_are_clamped_and_others_rounded() -> None:
    assert quantise(torch.tensor([-0.3, 0.4 / 255, 0.6 / 255, 1.7])).tolist() == [0, 0, 1, 255]


def test_pictures_survive_the_way_to_tensors_and_back() -> None:
    frames = np.random.default_rng(0).integers(0, 256, (2, 8, 6, 3), dtype=np.uint8)
    tensor = to_float(frames)
    assert tensor.shape == (2, 3, 8, 6)
    assert float(tensor[1, 2, 5, 4]) == np.float32(frames[1, 5, 4, 2]) / np.float32(255)
    np.testing.assert_array_equal(to_uint8(tensor), frames)
