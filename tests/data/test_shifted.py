"""Shifted copies of videos."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from playslot_rl.data.demonstrations import Demonstrations, transitions, with_copies
from playslot_rl.data.slot_cache import slot_cache
from playslot_rl.data.source import EpisodeFrames, open_sources
from playslot_rl.data.views import DIRECTIONS, concatenate, first_demonstrations, shift_frames, shifted, shifted_copies
from playslot_rl.modules.savi import SAVi
from playslot_rl.testing import tiny_config


@pytest.fixture
def source(foreign_images: Path, tmp_path: Path) -> EpisodeFrames:
    return open_sources(foreign_images, cache=tmp_path)


@pytest.mark.parametrize("offset", [(2, -3), (-1, 0), (0, 4)])
def test_every_frame_of_a_copy_moves_alike(source: EpisodeFrames, offset: tuple[int, int]) -> None:
    rows = np.array([[0, 3], [7, 1]])
    plain, moved = source.frames[rows], shifted(source, offset).frames[rows]
    assert np.array_equal(moved, shift_frames(plain, np.full((2, 2, 2), offset)))
    assert np.array_equal(shifted(source, offset).frames[7], moved[1, 0])
    size = source.image_size[0]
    for axis, by in zip((2, 3), offset, strict=True):
        kept = np.arange(size).take(range(max(0, by), size + min(0, by)))
        moved, plain = moved.take(kept, axis), plain.take(kept - by, axis)
    assert np.array_equal(moved, plain)


def test_copies_surround_the_original_and_have_names_of_their_own(source: EpisodeFrames) -> None:
    assert sorted(DIRECTIONS) == [(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if (y, x) != (0, 0)]
    assert np.array(DIRECTIONS[:4]).sum(0).tolist() == [0, 0], "the first four are balanced"
    assert list(shifted_copies(source, 0, 8)) == []
    copies = shifted_copies(source, 2, 4)
    assert len({source.fingerprint, *(copy.fingerprint for copy in copies)}) == 5
    assert len({copy.fingerprint for copy in (*copies, *shifted_copies(source, 1, 4))}) == 8
    for (y, x), copy in zip(DIRECTIONS, copies, strict=False):
        assert np.array_equal(copy.frames[5], shifted(source, (2 * y, 2 * x)).frames[5])


def test_a_copy_can_stand_beside_other_data(source: EpisodeFrames) -> None:
    both = concatenate([source, shifted(source, (1, 1))])
    last = len(both.frames) - 1
    assert np.array_equal(both.frames[[0, last]][1], shifted(source, (1, 1)).frames[len(source.frames) - 1])


def test_slots_of_the_first_episodes_are_those_of_the_whole(source: EpisodeFrames, tmp_path: Path) -> None:
    torch.manual_seed(0)
    savi = SAVi(replace(tiny_config().model.savi, decoder_channels=(16, 16)), 32)
    whole = slot_cache(shifted(source, (2, 0)), savi, "f" * 16, tmp_path)
    first = slot_cache(shifted(first_demonstrations(source, 1), (2, 0)), savi, "f" * 16, tmp_path)
    assert len(first) == source.lengths[0]
    np.testing.assert_allclose(first, whole[: len(first)], atol=1e-5)
    assert not np.allclose(first, slot_cache(source, savi, "f" * 16, tmp_path)[: len(first)], atol=1e-3)


def test_copies_carry_the_labels_of_their_originals(source: EpisodeFrames) -> None:
    moves = transitions(source)
    count = len(moves.rows)
    actions = torch.arange(count * 2.0).reshape(count, 2)

    def labelled(value: float) -> Demonstrations:
        slots = torch.full((count, 1, 1), value)
        return Demonstrations(
            slots=slots, imagined=slots, latents=slots[:, 0], actions=actions, episode=torch.from_numpy(moves.episode),
            step=torch.from_numpy(moves.step), lengths=torch.from_numpy(moves.lengths),
        )  # fmt: skip

    demos = with_copies([labelled(0.0), labelled(1.0), labelled(2.0)])
    assert demos.actions is not None
    assert demos.slots[:, 0, 0].tolist() == [0.0] * count + [1.0] * count + [2.0] * count
    assert torch.equal(demos.actions[2 * count :], actions)
    assert len(demos.lengths) == source.episodes
    first = int(moves.lengths[0])
    rows = demos.labelled(1)
    assert rows.tolist() == [*range(first), *range(count, count + first), *range(2 * count, 2 * count + first)]
