"""What SAVi's training is shown."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from tiny_savi import tiny_savi
from tiny_stages import SETTINGS, clips, videos
from torch import Tensor

from playslot_rl import keys
from playslot_rl.config import SlotsStageConfig
from playslot_rl.seeds.draws import StepGenerators
from playslot_rl.training.stage import step_loss
from playslot_rl.training.stage_slots import SlotsStage

ZOOMED = 2


def shown(step: int, seed: int = 0) -> Tensor:
    """The batch that one step of a training reads, which magnifies in its first two."""
    stage = SlotsStage(tiny_savi(), clips(32, 4), SlotsStageConfig(**SETTINGS, clip_frames=4, zoom_steps=ZOOMED))
    seen: list[TensorDict] = []
    for loss in (stage.criterion, stage.magnified):
        loss.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    step_loss(stage, step, StepGenerators(seed, step))
    batch: Tensor = seen[0][keys.PIXELS]
    return batch


def is_a_clip(batch: Tensor) -> bool:
    """Whether a batch's first frame is a frame of the videos."""
    frames = torch.from_numpy(videos(32).frames).movedim(-1, -3)
    return bool((frames == batch[0, 0]).flatten(1).all(1).any())


def test_single_frames_are_magnified_in_the_first_steps_and_then_clips_are_as_they_are() -> None:
    assert [is_a_clip(shown(step)) for step in range(4)] == [False, False, True, True]
    assert [shown(step).shape[1] for step in range(4)] == [1, 1, 4, 4]
    large = shown(0)
    assert torch.equal(large[..., ::2, ::2], large[..., 1::2, 1::2])  # every pixel of a half-size square, four times


def test_what_is_magnified_hangs_on_seed_and_step_alone() -> None:
    assert torch.equal(shown(1), shown(1))
    assert not torch.equal(shown(1), shown(0))
    assert not torch.equal(shown(1), shown(1, seed=1))


def test_the_background_is_that_of_the_training_videos_and_of_no_magnified_frames() -> None:
    shown = clips(32, 4)
    stage = SlotsStage(tiny_savi(), shown, SlotsStageConfig(**SETTINGS, clip_frames=4, foreground_weight=9.0))
    frames = torch.from_numpy(videos(32).frames[shown.spread(shown.train_episodes)].reshape(-1, 32, 32, 3))
    assert stage.criterion.backgrounds is not None
    assert torch.equal(stage.criterion.backgrounds, frames.movedim(-1, -3).float().div(255).median(0).values[None])
    assert (stage.criterion.foreground_weight, stage.magnified.foreground_weight) == (9.0, 0.0)
    assert SlotsStage(tiny_savi(), shown, SlotsStageConfig(**SETTINGS, clip_frames=4)).criterion.backgrounds is None
