"""Sizes of CADDY's parts, as many parameters as the paper's table says, and the shapes at other resolutions."""

from __future__ import annotations

import pytest
import torch
from caddy_parts import clips, tiny
from torch import nn

from playslot_rl.methods.caddy.method import CADDYConfig
from playslot_rl.methods.caddy.model import CADDY
from playslot_rl.methods.caddy.networks import ConvLSTM, Res

PARTS = {"encoder": 249_951, "action": 527_704, "dynamics": 7_933_952, "generator": 619_369, "pretraining": 73_856}


def count(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def model_of(**changes: object) -> CADDY:
    with torch.device("meta"):
        return CADDY(CADDYConfig(**changes), 64)  # type: ignore[arg-type]


def test_each_part_has_as_many_parameters_as_the_original() -> None:
    model = model_of()
    assert {name: count(part) for name, part in model.named_children() if count(part)} == PARTS
    assert count(model) == 9_404_832


@pytest.mark.parametrize(("changes", "expected"), [({"actions": 5}, 9_335_685), ({"latent_dim": 16}, 9_591_280)])
def test_other_actions_and_latents_have_as_many_as_the_original(changes: dict[str, int], expected: int) -> None:
    assert count(model_of(**changes)) == expected


def test_the_compact_model_is_an_eighth() -> None:
    model = model_of(encoder=(16, 16, 24, 32), dynamics=40, generator=(40, 32, 16))
    assert count(model) == 1_188_848


def test_a_residual_block_keeps_its_input_where_it_learned_nothing() -> None:
    block = Res(4, 4).eval()
    nn.init.zeros_(block.body[-1].weight)
    x = torch.rand(2, 4, 6, 6)
    assert torch.equal(block(x), x)
    assert Res(4, 7, 2).eval()(x).shape == (2, 7, 3, 3)


def test_a_recurrent_cell_is_an_lstm_at_each_place() -> None:
    torch.manual_seed(0)
    cell, reference = ConvLSTM(3, 5, 4), nn.LSTMCell(3, 5)
    with torch.no_grad():
        cell.gates.weight.zero_()
        weights = torch.cat((reference.weight_ih, reference.weight_hh), dim=1)
        order = torch.cat((torch.arange(10), torch.arange(15, 20), torch.arange(10, 15)))  # i, f, o, g of i, f, g, o
        cell.gates.weight[:, :, 1, 1] = weights[order]
        cell.gates.bias.copy_((reference.bias_ih + reference.bias_hh)[order])
        cell.first_hidden.normal_()
        cell.first_cell.normal_()
    x = torch.randn(2, 3, 4, 4)
    memory = cell.begin(2)
    expected = reference(x.movedim(1, -1).flatten(0, 2), tuple(part.movedim(1, -1).flatten(0, 2) for part in memory))
    for got, wanted in zip(cell(x, memory), expected, strict=True):
        torch.testing.assert_close(got.movedim(1, -1).flatten(0, 2), wanted)


@pytest.mark.parametrize("size", [16, 32, 48])
def test_any_multiple_of_16_is_a_frame_size(size: int) -> None:
    model = tiny(size).eval()
    frames = clips(2, 4, size)
    assert model.predict(frames, 2).shape == (2, 2, 3, size, size)
    rollout = model(frames, 2, 1.0, torch.Generator().manual_seed(0))
    assert [level.shape[-1] for level in rollout.generated.frames] == [size // 4, size // 2, size]
    assert rollout.s.shape == (2, 4, 8, size // 8, size // 8)


@pytest.mark.parametrize("size", [0, 24, 65])
def test_other_frame_sizes_are_refused(size: int) -> None:
    with pytest.raises(ValueError, match=f"got {size}, expected a multiple of 16"):
        tiny(size)
