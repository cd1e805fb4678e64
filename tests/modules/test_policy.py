"""The latent policy and the action decoder."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from playslot_rl.config import ActionDecoderConfig, PolicyConfig
from playslot_rl.modules.action_decoder import ActionDecoder
from playslot_rl.modules.policy import LatentPolicy
from playslot_rl.modules.transformer import SlotTokenEncoder

SMALL = PolicyConfig(dim=16, layers=2, heads=2, head_dim=8, mlp_dim=32)


def policy() -> LatentPolicy:
    torch.manual_seed(0)
    return LatentPolicy(SMALL, slot_dim=12, out_dim=6)


def test_the_policy_does_not_depend_on_the_order_of_the_slots() -> None:
    slots, order = torch.randn(2, 3, 12), torch.tensor([2, 0, 1])
    z = policy()(slots)
    torch.testing.assert_close(policy()(slots[:, order]), z)
    assert not torch.allclose(z[0], z[1])


def test_the_policy_sees_every_slot() -> None:
    slots = torch.randn(1, 3, 12)
    expected = policy()(slots)
    for n in range(3):
        other = slots.clone()
        other[:, n] = torch.randn(12)  # a constant would vanish in the layer norm
        assert not torch.allclose(policy()(other), expected, atol=1e-5)


def test_policy_and_decoder_see_the_chosen_slots_alone() -> None:
    torch.manual_seed(0)
    chosen, slots, task = (3, 1), torch.randn(2, 4, 12), torch.tensor([[0], [1]])
    sizes = ActionDecoderConfig(16, state_dim=8, state_heads=2, reads_slots=True)
    whole, some = (LatentPolicy(replace(SMALL, slots=seen), 12, 6, tasks=2).eval() for seen in ((), chosen))
    reads, reads_some = (ActionDecoder(replace(sizes, slots=seen), 6, 4, 12).eval() for seen in ((), chosen))
    some.load_state_dict(whole.state_dict())
    reads_some.load_state_dict(reads.state_dict())
    few = slots[:, [2, 0]]
    z = whole(few, task)
    torch.testing.assert_close(some(slots, task), z)
    torch.testing.assert_close(reads_some(z, slots), reads(z, few))
    assert not torch.allclose(whole(slots, task), z)
    assert not torch.allclose(reads(z, slots), reads(z, few))


def test_a_slot_is_chosen_once() -> None:
    with pytest.raises(ValueError, match=r"model\.policy\.slots: got .*expected each slot once"):
        replace(SMALL, slots=(2, 2))


def test_the_policy_takes_any_leading_shape_row_by_row() -> None:
    slots = torch.randn(2, 4, 3, 12)
    z = policy()(slots)
    assert z.shape == (2, 4, 6)
    torch.testing.assert_close(z[1, 2], policy()(slots[1, 2]))


def test_decoded_actions_stay_inside_the_action_space() -> None:
    torch.manual_seed(0)
    decoder = ActionDecoder(ActionDecoderConfig(hidden_dim=16), latent_dim=6, action_dim=4)
    actions = decoder(torch.randn(5, 7, 6) * 100)
    assert actions.shape == (5, 7, 4)
    assert actions.abs().max() <= 1
    assert actions.abs().max() > 0.99
    assert sum(isinstance(layer, torch.nn.Linear) for layer in decoder.layers) == 3


def test_the_last_layer_computes_the_act_token_alone_and_loses_nothing() -> None:
    torch.manual_seed(0)
    encoder, slots = SlotTokenEncoder(16, 32, 2, 2, 16, 64), torch.randn(3, 5, 16)
    tokens = encoder.to_token(encoder.norm(slots))
    x = torch.cat((encoder.act_token.expand(3, 1, -1), tokens), dim=1)
    for block in encoder.blocks:
        x, _ = block(x)
    torch.testing.assert_close(encoder(slots), x[:, 0])
    widths: list[tuple[int, ...]] = []
    encoder.blocks[-1].mlp.register_forward_hook(lambda _module, given, _out: widths.append(tuple(given[0].shape)))
    encoder(slots)
    assert widths == [(3, 1, 32)]
