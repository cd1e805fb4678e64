"""The stream gives the clips of its seeds, each once, with any number of workers."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from playslot_rl import keys
from playslot_rl.config import EnvConfig, GridConfig
from playslot_rl.data.grid_stream import GridShapesStream
from playslot_rl.envs.grid_shapes import generate
from playslot_rl.errors import ConfigError


def test_clips_are_those_of_their_seeds() -> None:
    stream, clips = list(GridShapesStream(first=7, clips=40, steps=4)), generate(range(7, 47), 4, EnvConfig())
    assert len(stream) == 40
    for i, clip in enumerate(stream):
        assert int(clip[keys.FEATURE_SEED]) == 7 + i
        np.testing.assert_array_equal(clip[keys.PIXELS].movedim(-3, -1), clips.frames[i])
        np.testing.assert_array_equal(clip[keys.OBJECT_MOVES], clips.moves[i])
        np.testing.assert_array_equal(clip[keys.OBJECT_MASKS], clips.masks[i])


def test_without_an_end_it_goes_on() -> None:
    assert [int(clip[keys.FEATURE_SEED]) for clip in islice(GridShapesStream(steps=1), 70)] == list(range(70))


@pytest.mark.slow
def test_workers_share_the_seeds() -> None:
    loader = DataLoader(GridShapesStream(clips=75, steps=2), batch_size=5, num_workers=2)
    seeds = torch.cat([batch[keys.FEATURE_SEED] for batch in loader])
    assert sorted(seeds.tolist()) == list(range(75))


def test_a_wrong_action_width_is_refused_at_once() -> None:
    with pytest.raises(ConfigError, match=r"env\.action_dim: got 4, expected 2"):
        GridShapesStream(env=EnvConfig(grid=GridConfig(objects=1)))
