"""What the action decoder of a method that clones latents learns from."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from clips import moving_square
from torch import Tensor

from playslot_rl.config import StageConfig
from playslot_rl.config.compose import compose
from playslot_rl.data.demonstrations import DemonstrationSplit, Transitions
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.views import DIRECTIONS, shifted
from playslot_rl.methods.cloning import LatentCloning


class Cloning(LatentCloning):
    """The latent of a transition is its frame's number; features are the frame."""

    def infer(self, source: EpisodeFrames, moves: Transitions) -> Tensor:
        return torch.from_numpy(moves.rows)[:, None].float()


@pytest.mark.parametrize("shift", [0, 2])
def test_the_decoder_reads_features_of_shifted_frames_where_the_policy_does(shift: int) -> None:
    config = compose(["preset=smoke", "env=button_press", "env.image_size=32", "behaviour.labelled_demos=2"])
    source = replace(moving_square(), actions=np.random.default_rng(0).uniform(-1, 1, (24, 4)).astype(np.float32))
    split = DemonstrationSplit(trained=source, parsed=source, held_out=None)
    behaviour = Cloning(config, split, torch.device("cpu"), shift, StageConfig(), "l1")
    behaviour.policy = SimpleNamespace(features=lambda pixels: pixels.float().flatten(1))
    shown = behaviour._shown(behaviour.labelled)
    own = len(behaviour.labelled)
    views = [source, *(shifted(source, (shift * y, shift * x)) for y, x in DIRECTIONS if shift)]
    rows = behaviour.trained.moves.rows[behaviour.labelled.numpy()]
    wanted = np.concatenate([view.frames[rows] for view in views])
    np.testing.assert_array_equal(shown.slots.view(-1, 3, 32, 32).movedim(1, -1).numpy(), wanted)
    assert torch.equal(shown.latents[:, 0], torch.from_numpy(rows).float().repeat(len(views)))
    assert torch.equal(shown.require_actions(), shown.require_actions()[:own].repeat(len(views), 1))
    assert shown.labelled(1).numel() == len(views) * int((shown.episode[:own] == 0).sum())
