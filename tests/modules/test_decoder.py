"""SAVi's decoders: the collapsed first layer is the plain one, exactly; masks sum to one; bf16 touches convs only."""

from __future__ import annotations

import copy

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from playslot_rl.config import SAViConfig
from playslot_rl.modules.savi import SAVi
from playslot_rl.modules.savi.decoder import BroadcastDecoder, PixelShuffleDecoder

SIZES = [5, 6, 9, 16, 33]


def pair(size: int, dtype: torch.dtype = torch.float64) -> tuple[BroadcastDecoder, BroadcastDecoder]:
    """The same weights, collapsed and plain."""
    torch.manual_seed(size)
    collapsed = BroadcastDecoder(size, 12, (8, 8), collapse=True).to(dtype)
    torch.nn.init.normal_(collapsed.convs[0].bias)  # a zero bias would hide its double use
    plain = copy.deepcopy(collapsed)
    plain.collapse = False
    return collapsed, plain


def gradients(decoder: BroadcastDecoder, slots: Tensor, weights: Tensor) -> dict[str, Tensor]:
    slots = slots.clone().requires_grad_()
    (decoder(slots) * weights).sum().backward()
    assert slots.grad is not None
    found = {name: parameter.grad for name, parameter in decoder.named_parameters()}
    return {"slots": slots.grad, **{name: grad for name, grad in found.items() if grad is not None}}


@pytest.mark.parametrize("size", SIZES)
def test_the_collapsed_first_layer_equals_the_plain_one_at_every_pixel(size: int) -> None:
    collapsed, plain = pair(size)
    slots = torch.randn(3, 12, dtype=torch.float64)
    got, expected = collapsed.first_layer(slots), plain.first_layer(slots)
    assert got.shape == (3, 8, size, size)
    for row in range(size):
        for column in range(size):
            torch.testing.assert_close(
                got[:, :, row, column], expected[:, :, row, column], msg=lambda m, r=row, c=column: f"({r}, {c}): {m}"
            )


@pytest.mark.parametrize("size", SIZES)
def test_the_collapsed_first_layer_has_the_plain_ones_gradients(size: int) -> None:
    collapsed, plain = pair(size)
    slots = torch.randn(3, 12, dtype=torch.float64)
    weights = torch.randn(3, 4, size, size, dtype=torch.float64)
    got, expected = gradients(collapsed, slots, weights), gradients(plain, slots, weights)
    assert set(got) == set(expected) == {"slots", *dict(plain.named_parameters())}
    for name in expected:
        assert expected[name].abs().max() > 1e-3, name
        torch.testing.assert_close(got[name], expected[name], msg=lambda m, n=name: f"{n}: {m}")


def test_collapsed_and_plain_give_the_same_loss_in_single_precision() -> None:
    collapsed, plain = pair(32, torch.float32)
    slots = torch.randn(4, 12)
    torch.testing.assert_close(collapsed(slots), plain(slots), rtol=1e-5, atol=1e-6)


def test_the_memory_format_changes_no_value() -> None:
    for decoder in pair(16):
        slots = torch.randn(2, 12, dtype=torch.float64)
        expected = decoder(slots)
        decoder.channels_last = False
        got = decoder(slots)
        assert got.is_contiguous()
        torch.testing.assert_close(got, expected)


@pytest.mark.parametrize("size", [32, 64])
def test_a_later_start_has_as_many_convolutions_and_a_finer_map(size: int) -> None:
    torch.manual_seed(0)
    widths = (8, 12, 6)[: 2 if size == 32 else 3]
    early, late = (PixelShuffleDecoder(size, 16, widths, True, start) for start in (8, 16))
    assert len(late.convs) == len(early.convs) == len(widths)
    assert late.position_map is not None
    assert late.position_map.shape == (1, 8, 16, 16)
    slots = torch.randn(3, 16)
    assert late(slots).shape == early(slots).shape == (3, 4, size, size)
    with torch.no_grad():
        before = late(slots)
        late.position_map[..., 15, 15] += 1.0
        changed = (late(slots) - before).abs().amax(dim=(0, 1)) > 0
    assert changed[-1, -1]
    assert not changed[: size // 2].any()


def configs() -> dict[str, SAViConfig]:
    shared = {"n_slots": 3, "slot_dim": 16, "encoder_channels": (8, 8), "token_dim": 16, "corrector_mlp": 16}
    rest = {"transition_heads": 2, "transition_mlp": 16}
    return {
        "broadcast": SAViConfig(**shared, **rest, encoder_strides=(1, 1), decoder_channels=(8, 8)),
        "pixel_shuffle": SAViConfig(
            **shared,
            **rest,
            encoder_strides=(2, 2),
            encoder="strided",
            decoder="pixel_shuffle",
            decoder_channels=(8, 8),
        ),
    }


@pytest.mark.parametrize("name", ["broadcast", "pixel_shuffle"])
def test_masks_sum_to_one_and_blend_the_colours_into_the_frame(name: str) -> None:
    torch.manual_seed(0)
    savi = SAVi(configs()[name], image_size=32)
    out = savi.decode(torch.randn(2, 4, 3, 16))
    assert out.frames.shape == (2, 4, 3, 32, 32)
    assert out.rgb.shape == (2, 4, 3, 3, 32, 32)
    assert out.masks.shape == (2, 4, 3, 1, 32, 32)
    assert (out.masks > 0).all()
    assert out.masks.std(dim=2).max() > 1e-3, "the slots must compete"
    torch.testing.assert_close(out.masks.sum(dim=2), torch.ones(2, 4, 1, 32, 32))
    torch.testing.assert_close(out.frames, (out.masks * out.rgb).sum(dim=2))


@pytest.mark.parametrize("name", ["broadcast", "pixel_shuffle"])
def test_the_frame_does_not_depend_on_the_order_of_the_slots(name: str) -> None:
    torch.manual_seed(0)
    savi = SAVi(configs()[name], image_size=32)
    slots, order = torch.randn(2, 3, 16), torch.tensor([2, 0, 1])
    out, permuted = savi.decode(slots), savi.decode(slots[:, order])
    torch.testing.assert_close(permuted.masks, out.masks[:, order])
    torch.testing.assert_close(permuted.frames, out.frames)


@pytest.mark.parametrize("name", ["broadcast", "pixel_shuffle"])
def test_bf16_stays_close_and_reaches_only_the_convolutions(name: str) -> None:
    torch.manual_seed(0)
    savi = SAVi(configs()[name], image_size=32)
    frames = torch.rand(1, 3, 3, 32, 32)
    noise = torch.Generator().manual_seed(1)
    slots, _ = savi(frames, generator=noise)
    decoded = savi.decode(slots)
    seen: dict[str, torch.dtype] = {}
    for key, module in savi.named_modules():
        if module is savi.decoder or isinstance(module, (torch.nn.Conv2d, torch.nn.GRUCell, torch.nn.LayerNorm)):
            module.register_forward_hook(lambda _m, _i, out, key=key: seen.__setitem__(key, out.dtype))
    savi.precision = "bf16"
    fast_slots, state = savi(frames, generator=noise.manual_seed(1))
    fast = savi.decode(slots)
    convs = {key for key in seen if isinstance(savi.get_submodule(key), torch.nn.Conv2d)} | {"decoder"}
    assert {seen[key] for key in convs} == {torch.bfloat16}
    assert {seen[key] for key in set(seen) - convs} == {torch.float32}
    assert {x.dtype for x in (fast_slots, state, *fast)} == {torch.float32}
    assert not torch.equal(fast.frames, decoded.frames)
    torch.testing.assert_close(fast.frames, decoded.frames, rtol=0.02, atol=0.02)
    torch.testing.assert_close(fast_slots, slots, rtol=0.05, atol=0.05)


def test_doubling_in_runs_is_a_pixel_shuffle_of_the_convolution() -> None:
    torch.manual_seed(0)
    decoder = PixelShuffleDecoder(32, 16, (8, 12)).double()
    slots = torch.randn(3, 16, dtype=torch.float64)
    x = F.relu(decoder.project(slots)[:, :, None, None] + decoder.position())
    x = F.relu(F.pixel_shuffle(decoder.convs[0](x), 2))
    expected = F.pixel_shuffle(decoder.convs[1](x), 2)
    got = decoder(slots)
    torch.testing.assert_close(got, expected)
    target, weights = torch.randn_like(expected), list(decoder.convs.parameters())
    of_got, of_expected = (torch.autograd.grad((y * target).sum(), weights) for y in (got, expected))
    for one, other in zip(of_got, of_expected, strict=True):
        torch.testing.assert_close(one, other)


def test_a_pixel_shuffle_decoder_needs_one_width_for_each_doubling() -> None:
    with pytest.raises(ValueError, match="got 2 widths, expected 3"):
        PixelShuffleDecoder(64, 16, (8, 8))
