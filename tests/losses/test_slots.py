"""SAVi's reconstruction loss."""

from __future__ import annotations

import torch
from tensordict import TensorDict

from playslot_rl import keys
from playslot_rl.losses import SlotsLoss, total_loss
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
