"""GridShapes' clips drawn for a batch: the same pixels and the same chances as those of `generate`."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from playslot_rl.config import EnvConfig, GridConfig
from playslot_rl.config.compose import compose
from playslot_rl.data.drawn_clips import DrawnClips, padded_sprites, paint
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.envs.grid_shapes import DISPLACEMENTS, MOVES, PALETTE, generate, visited
from playslot_rl.errors import ConfigError
from playslot_rl.runtime.shares import Share, sharing
from playslot_rl.seeds.draws import StepGenerators

CPU = torch.device("cpu")


def settings(objects: int = 2, image_size: int = 64, **grid: int) -> EnvConfig:
    return EnvConfig("grid_shapes", image_size, 2 * objects, grid=GridConfig(objects, **grid))


def clips(frames: int, stride: int = 1) -> DrawnClips:
    held_out = generate([0], 20, settings()).frames[0]
    one = np.zeros(1, np.int64)
    source = EpisodeFrames(held_out, one, one + 21, None, None, "f", 10.0, "", "camera")
    return DrawnClips(settings(), stride, source, frames, 0.1, 0)


@pytest.mark.parametrize("env", [settings(1, size=3), settings(2), settings(5, 32, size=16), settings(3, 128, speed=5)])
def test_the_states_of_a_generated_clip_are_painted_pixel_for_pixel(env: EnvConfig) -> None:
    made = generate(range(20), 15, env)
    colours = np.concatenate([made.ground[:, None], made.colours], 1)
    states = [torch.from_numpy(part) for part in (made.corners, made.shapes, colours)]
    painted = paint(*states, padded_sprites(env.grid.size), env.image_size)
    assert painted.is_contiguous()
    np.testing.assert_array_equal(painted.movedim(2, -1).numpy(), made.frames)


def test_clips_are_drawn_with_the_chances_of_generate() -> None:
    count, env = 3000, settings(2, 32, size=9)
    made = generate(range(count), 5, env)
    corners, shapes, colours = visited(np.random.default_rng(0), count, 5, env)
    assert (corners.shape, shapes.shape, colours.shape) == ((count, 6, 2, 2), (count, 2), (count, 3))
    assert not (colours[:, :1] == colours[:, 1:]).any(), "the ground has a colour of its own"

    def moved(at: np.ndarray) -> np.ndarray:
        """Each two moves of an object, one after the other."""
        labels = np.abs(np.diff(at, axis=1)[..., None, :] / 2 - DISPLACEMENTS).sum(-1).argmin(-1)
        return labels[:, :-1] * len(MOVES) + labels[:, 1:]

    index = {tuple(colour): i for i, colour in enumerate(PALETTE.tolist())}
    painted = np.concatenate([made.ground[:, None], made.colours], 1).tolist()
    known = [[index[tuple(colour)] for colour in clip] for clip in painted]
    for one, other in (
        (corners[:, 0], made.corners[:, 0]),
        (corners[:, -1], made.corners[:, -1]),
        (moved(corners), moved(made.corners)),
        (shapes, made.shapes),
        (colours[:, 0], np.array(known)[:, 0]),
        (colours @ [0, 10, 1], np.array(known) @ [0, 10, 1]),
    ):
        size = max(one.max(), other.max()) + 1
        got, wanted = (np.bincount(values.ravel(), minlength=size) / values.size for values in (one, other))
        assert got[wanted == 0].max(initial=0) < 0.002
        assert (np.abs(got - wanted) <= 5 * np.sqrt(2 * (wanted + 1 / other.size) / other.size)).all()


def test_a_batch_is_a_function_of_seed_and_step_and_no_two_are_alike() -> None:
    drawn = clips(4)
    first = drawn.batch("windows", 6, StepGenerators(3, 7), CPU)
    assert (first.shape, first.dtype) == ((6, 4, 3, 64, 64), torch.uint8)
    assert torch.equal(first, drawn.batch("windows", 6, StepGenerators(3, 7), CPU))
    for seed, step in ((3, 8), (4, 7)):
        other = drawn.batch("windows", 6, StepGenerators(seed, step), CPU)
        assert not (first[:, None] == other[None]).flatten(2).all(2).any()
    assert torch.equal(first[:, :1], drawn.batch("windows", 6, StepGenerators(3, 7), CPU, 1))
    with sharing(Share(1, 3)):
        assert torch.equal(first[2:4], drawn.batch("windows", 6, StepGenerators(3, 7), CPU))


def test_a_stride_leaves_out_what_lies_between() -> None:
    every = clips(7).batch("windows", 3, StepGenerators(0, 0), CPU)
    assert torch.equal(every[:, ::3], clips(3, stride=3).batch("windows", 3, StepGenerators(0, 0), CPU))


def test_what_cannot_be_drawn_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"data\.drawn: got True, expected false with env=button_press, whose clips"):
        compose(["env=button_press", "data.drawn=true"])
    with pytest.raises(ConfigError, match=r"env\.action_dim: got 4, expected 6"):
        DrawnClips(EnvConfig("grid_shapes", grid=GridConfig(3)), 1, clips(2).source, 2, 0.1, 0)
    assert compose(["env=grid_shapes", "data.drawn=true"]).data.drawn
