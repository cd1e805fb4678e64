"""SAVi's reconstruction loss."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from playslot_rl import keys
from playslot_rl.losses import SlotsLoss, total_loss
from playslot_rl.losses.slots import background, foreground, moving
from playslot_rl.testing import tiny_agent


def clips(seed: int = 0) -> TensorDict:
    generator = torch.Generator().manual_seed(seed)
    pixels = torch.randint(256, (2, 3, 3, 64, 64), dtype=torch.uint8, generator=generator)
    return TensorDict({keys.PIXELS: pixels}, [2])


def test_it_is_the_mean_squared_error_of_the_reconstruction() -> None:
    savi, batch = tiny_agent().world_model.savi, clips()
    out = SlotsLoss(savi)(batch)
    frames = batch[keys.PIXELS].float() / 255
    slots, _ = savi(frames)
    expected = torch.nn.functional.mse_loss(savi.decode(slots).frames, frames)
    torch.testing.assert_close(out["loss_reconstruction"], expected)
    torch.testing.assert_close(total_loss(out), expected)
    torch.testing.assert_close(out["psnr"], -10 * expected.log10())


def test_float_and_uint8_frames_are_the_same() -> None:
    loss, batch = SlotsLoss(tiny_agent().world_model.savi), clips()
    as_float = TensorDict({keys.PIXELS: batch[keys.PIXELS].float() / 255}, [2])
    assert torch.equal(loss(batch)["loss_reconstruction"], loss(as_float)["loss_reconstruction"])


def test_every_parameter_that_matters_gets_a_gradient() -> None:
    savi = tiny_agent().world_model.savi
    SlotsLoss(savi)(clips())["loss_reconstruction"].backward()
    without = [name for name, p in savi.named_parameters() if p.grad is None or p.grad.abs().sum() == 0]
    # The last bias of the masks shifts all logits alike, which a softmax over slots ignores; no other may be idle.
    assert all("decoder" in name and name.endswith("bias") for name in without), without


def test_the_network_stays_an_ordinary_submodule_and_keys_can_be_renamed() -> None:
    savi = tiny_agent().world_model.savi
    loss = SlotsLoss(savi)
    assert loss.savi is savi
    loss.eval()
    assert not savi.training
    loss.set_keys(pixels="video")
    assert loss.in_keys == ["video"]
    loss(clips().rename_key_(keys.PIXELS, "video"))


def test_a_pixel_that_moves_counts_more_in_its_own_clip() -> None:
    savi, frames = tiny_agent().world_model.savi, torch.full((2, 3, 3, 64, 64), 0.5)
    frames[0, 1:, :, 4:8, 10] = 0.9  # moves from the first frame to the second, then stands still
    batch = TensorDict({keys.PIXELS: frames}, [2])
    moves = moving(frames)
    assert (moves.sum((2, 3)) == torch.tensor([[4.0, 4.0, 0.0], [0.0, 0.0, 0.0]])).all()
    assert (moves[0, :2, 4:8, 10] == 1).all()

    error = (savi.decode(savi(frames)[0]).frames - frames).square().mean(2)
    of_moving, rest = error[0][moves[0] > 0].sum(), error[0][moves[0] == 0].sum()
    first = (10 * of_moving + rest) / (10 * 8 + error[0].numel() - 8)
    weighted, plain = SlotsLoss(savi, motion_weight=9.0)(batch), SlotsLoss(savi)(batch)
    torch.testing.assert_close(weighted["loss_reconstruction"], (first + error[1].mean()) / 2)
    assert weighted["loss_reconstruction"] > plain["loss_reconstruction"]
    assert torch.equal(weighted["psnr"], plain["psnr"])


def test_what_lies_still_counts_more_where_it_is_not_the_background() -> None:
    savi, frames = tiny_agent().world_model.savi, torch.full((3, 2, 3, 64, 64), 0.5)
    frames[:, :, :, 20:40, 20:40] = 0.9  # in every clip: the ground
    frames[0, :, 0, 4:8, 10] = 0.9  # a goal
    usual = background(frames)
    assert torch.equal(usual, frames[1, 0])
    found = foreground(frames, usual[None])
    assert (found[0, :, 4:8, 10] == 1).all()
    assert (found.sum((2, 3)) == torch.tensor([[4.0, 4.0], [0.0, 0.0], [0.0, 0.0]])).all()
    assert moving(frames).sum() == 0

    error = (savi.decode(savi(frames)[0]).frames - frames).square().mean(2)
    of_goal, rest = error[0][found[0] > 0].sum(), error[0][found[0] == 0].sum()
    first = (10 * of_goal + rest) / (10 * 8 + error[0].numel() - 8)
    loss = SlotsLoss(savi, foreground_weight=9.0, backgrounds=usual[None])
    weighted = loss(TensorDict({keys.PIXELS: frames}, [3]))
    torch.testing.assert_close(weighted["loss_reconstruction"], (first + error[1].mean() + error[2].mean()) / 3)


def test_the_background_is_that_of_the_clips_own_scene() -> None:
    scenes = torch.full((2, 3, 3, 8, 8), 0.5)
    scenes[1, :, :, 3:] = 0.9  # another table
    frames = scenes.repeat_interleave(2, 0)
    frames[::2, :, :, 1, 1] = 0.0  # a goal, in every second clip of each
    found = foreground(frames, torch.stack([background(scene) for scene in scenes]))
    assert (found[::2, :, 1, 1] == 1).all()
    assert (found.sum((2, 3)) == torch.tensor([1.0, 0.0, 1.0, 0.0])[:, None]).all()
    of_both = foreground(frames, background(scenes)[None])
    assert of_both.mean((1, 2, 3)).amax() > 0.5  # what tells the scenes apart hides the goal


def test_nothing_moves_in_a_clip_of_one_frame() -> None:
    assert moving(torch.rand(2, 1, 3, 4, 4)).sum() == 0


def test_a_foreground_needs_a_background() -> None:
    with pytest.raises(ValueError, match="got foreground_weight=30 without backgrounds"):
        SlotsLoss(tiny_agent().world_model.savi, foreground_weight=30.0)
