"""World models on slots as video predictors, and the rows that put their numbers in their place."""

from __future__ import annotations

from typing import Literal

import pytest
import torch
from torch import Tensor

from playslot_rl.config import LatentMode, PredictorConfig
from playslot_rl.methods.video.predictor import LastFrame, Reconstruction, SlotVideo, VideoPredictor
from playslot_rl.testing import tiny_config
from playslot_rl.world_model import WorldModel

Kind = Literal["cocvp", "ocvp_seq", "slotformer"]
CASES: tuple[tuple[Kind, LatentMode], ...] = (
    ("cocvp", "hybrid"), ("ocvp_seq", "hybrid"), ("ocvp_seq", "none"), ("slotformer", "none"),
)  # fmt: skip
B, T, S = 2, 5, 2


def model(kind: Kind = "cocvp", mode: LatentMode = "hybrid") -> SlotVideo:
    from dataclasses import replace

    config = tiny_config(mode)
    sizes = PredictorConfig(kind=kind, dim=16, layers=1, heads=2, head_dim=8, mlp_dim=16, context=8)
    torch.manual_seed(0)
    return SlotVideo(WorldModel(replace(config.model, predictor=sizes), config.env).eval())


def clips(seed: int = 0) -> Tensor:
    return torch.rand(B, T, 3, 64, 64, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(("kind", "mode"), CASES)
def test_it_gives_a_frame_for_each_one_past_the_seed(kind: Kind, mode: LatentMode) -> None:
    predictor: VideoPredictor = model(kind, mode)
    assert predictor.predict(clips(), S).shape == (B, T - S, 3, 64, 64)
    assert predictor.infers == (mode != "none")


@pytest.mark.parametrize(("kind", "mode"), CASES)
def test_the_future_enters_through_latents_alone(kind: Kind, mode: LatentMode) -> None:
    """With donors, or with nothing inferred, what comes after the seed has no effect; otherwise it has."""
    predictor, frames = model(kind, mode), clips()
    other = torch.cat((frames[:, :S], clips(1)[:, S:]), dim=1)
    torch.testing.assert_close(predictor.predict(frames, S, clips(2)), predictor.predict(other, S, clips(2)))
    moved = (predictor.predict(frames, S) - predictor.predict(other, S)).abs().max()
    assert (moved > 1e-7) == (mode != "none")


@pytest.mark.parametrize(("kind", "mode"), CASES)
def test_donors_steer_only_what_infers(kind: Kind, mode: LatentMode) -> None:
    predictor, frames = model(kind, mode), clips()
    moved = (predictor.predict(frames, S, clips(2)) - predictor.predict(frames, S)).abs().max()
    assert (moved > 1e-7) == (mode != "none")


def test_real_actions_are_asked_for() -> None:
    predictor, frames = model(mode="ground_truth"), clips()
    assert predictor.needs_actions
    width = predictor.model.env.action_dim
    one, other = (predictor.predict(frames, S, actions=torch.full((B, T - 1, width), value)) for value in (0.0, 1.0))
    assert not torch.allclose(one, other)
    with pytest.raises(ValueError, match="got no actions"):
        predictor.predict(frames, S)


def test_the_ceiling_is_the_reconstruction_of_the_true_frames() -> None:
    savi, frames = model().model.savi, clips()
    expected = savi.decode(savi.parse(frames)).frames[:, S:]
    torch.testing.assert_close(Reconstruction(savi).predict(frames, S), expected)


def test_the_floor_repeats_the_last_seed_frame() -> None:
    frames = clips()
    out = LastFrame().predict(frames, S)
    assert out.shape == (B, T - S, 3, 64, 64)
    for t in range(T - S):
        assert torch.equal(out[:, t], frames[:, S - 1])


@pytest.mark.parametrize("seed", [0, T])
def test_a_clip_needs_a_seed_and_a_frame_past_it(seed: int) -> None:
    for predictor in (model(), LastFrame(), Reconstruction(model().model.savi)):
        with pytest.raises(ValueError, match="clip: got 5 frames"):
            predictor.predict(clips(), seed)
