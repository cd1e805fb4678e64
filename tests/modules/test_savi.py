"""SAVi's parsing: recurrent state, iterations, initial slots, Slot Attention by the formula."""

from __future__ import annotations

import pytest
import torch
from tiny_savi import tiny_savi

from playslot_rl.modules.savi import SAVi
from playslot_rl.modules.savi.corrector import SlotAttention
from playslot_rl.modules.savi.initializer import SlotInitializer


def small(initial: str = "learned", **changes: object) -> SAVi:
    torch.manual_seed(1)  # the frames that the tests draw
    return tiny_savi(initial=initial, **changes)


@pytest.mark.parametrize("initial", ["learned", "gaussian"])
@pytest.mark.parametrize("cut", [1, 2, 4])
def test_carrying_the_state_on_equals_parsing_the_clip_at_once(initial: str, cut: int) -> None:
    savi, frames = small(initial), torch.rand(2, 5, 3, 32, 32)
    whole, end = savi(frames, generator=torch.Generator().manual_seed(0))
    head, state = savi(frames[:, :cut], generator=torch.Generator().manual_seed(0))
    tail, last = savi(frames[:, cut:], state)
    torch.testing.assert_close(torch.cat((head, tail), dim=1), whole)
    torch.testing.assert_close(last, end)


def test_the_state_is_the_transition_of_the_last_corrected_slots() -> None:
    savi = small()
    slots, state = savi(torch.rand(2, 3, 3, 32, 32))
    torch.testing.assert_close(state, savi.transition(slots[:, -1]))
    assert not torch.allclose(state, slots[:, -1])


def test_slots_never_see_later_frames() -> None:
    savi, frames = small(), torch.rand(1, 4, 3, 32, 32)
    other = frames.clone()
    other[:, 2:] = torch.rand(1, 2, 3, 32, 32)
    a, b = savi(frames)[0], savi(other)[0]
    torch.testing.assert_close(a[:, :2], b[:, :2], rtol=0, atol=0)
    assert not torch.allclose(a[:, 2], b[:, 2])


def test_the_first_frame_gets_three_iterations_and_later_ones_one() -> None:
    savi, seen = small(), []
    savi.corrector.register_forward_hook(lambda _m, inputs, _o: seen.append(inputs[3]))
    frames = torch.rand(1, 3, 3, 32, 32)
    _, state = savi(frames)
    savi(frames[:, :2], state)
    assert seen == [3, 1, 1, 1, 1]


def test_slot_attention_follows_its_formula() -> None:
    torch.manual_seed(0)
    corrector = SlotAttention(slot_dim=8, token_dim=6, mlp_dim=10)
    tokens, slots = torch.randn(1, 7, 6), torch.randn(1, 3, 8)
    k, v = corrector.keys_values(tokens)
    logits = torch.stack([(corrector.to_q(corrector.norm_slots(slots[0, n])) * k[0]).sum(-1) for n in range(3)])
    attention = (logits / 8**0.5).exp()
    attention = attention / attention.sum(dim=0) + 1e-8  # slots compete for every location
    attention = attention / attention.sum(dim=1, keepdim=True)  # weighted mean over locations
    updated = corrector.gru(attention @ v[0], slots[0])
    expected = updated + corrector.mlp(corrector.norm_mlp(updated))
    torch.testing.assert_close(corrector(k, v, slots, 1)[0], expected)
    torch.testing.assert_close(corrector(k, v, slots, 2), corrector(k, v, corrector(k, v, slots, 1), 1))


def test_correcting_and_transition_are_equivariant_to_the_order_of_the_slots() -> None:
    savi, order = small(), torch.tensor([1, 2, 0])
    k, v = savi.corrector.keys_values(torch.randn(2, 9, 12))
    slots = torch.randn(2, 3, 16)
    torch.testing.assert_close(savi.corrector(k, v, slots[:, order], 2), savi.corrector(k, v, slots, 2)[:, order])
    torch.testing.assert_close(savi.transition(slots[:, order]), savi.transition(slots)[:, order])


def test_gaussian_initial_slots_share_a_mean_and_a_scale_and_repeat_with_the_generator() -> None:
    initializer = SlotInitializer(3, 16, "gaussian")
    with torch.no_grad():
        initializer.mean.fill_(2.0)
        initializer.log_scale.fill_(-1.0)
    drawn = initializer(4000, torch.Generator().manual_seed(0))
    assert drawn.shape == (4000, 3, 16)
    assert abs(drawn.mean().item() - 2.0) < 0.01
    assert abs(drawn.std().item() - torch.tensor(-1.0).exp().item()) < 0.01
    assert torch.equal(drawn, initializer(4000, torch.Generator().manual_seed(0)))
    assert not torch.equal(drawn, initializer(4000, torch.Generator().manual_seed(1)))
    drawn.sum().backward()
    assert initializer.mean.grad is not None
    assert initializer.log_scale.grad is not None


def test_learned_initial_slots_are_one_vector_a_slot_without_noise() -> None:
    initializer = SlotInitializer(3, 16, "learned")
    slots = initializer(5)
    assert slots.shape == (5, 3, 16)
    assert torch.equal(slots[0], slots[4])
    assert not torch.equal(slots[0, 0], slots[0, 1])
    assert sum(parameter.numel() for parameter in initializer.parameters()) == 48


def test_weights_start_xavier_with_zero_biases_and_an_orthogonal_gru() -> None:
    savi = small()
    hidden = savi.corrector.gru.weight_hh
    torch.testing.assert_close(hidden.T @ hidden, torch.eye(16), rtol=0, atol=1e-5)
    limit = (6 / (16 + 16)) ** 0.5
    assert 0.9 * limit < savi.corrector.to_q.weight.abs().max().item() <= limit
    for name, parameter in savi.named_parameters():
        if "bias" in name:
            assert not parameter.any(), name


def test_gradients_reach_every_parameter() -> None:
    savi, frames = small("gaussian"), torch.rand(1, 2, 3, 32, 32)
    slots, _ = savi(frames, generator=torch.Generator().manual_seed(0))
    (savi.decode(slots).frames - frames).square().mean().backward()
    silent = {n for n, p in savi.named_parameters() if p.grad is None or not p.grad.any()}
    assert silent == set()


def test_a_transition_that_starts_as_identity_hands_the_slots_on_and_can_learn() -> None:
    savi = small(transition_start="identity")
    slots, state = savi(torch.rand(2, 3, 3, 32, 32))
    torch.testing.assert_close(state, slots[:, -1], rtol=0, atol=0)
    state.square().sum().backward()
    for weight in (savi.transition.block.to_v.weight, savi.transition.block.mlp[-1].weight):  # type: ignore[index]
        assert weight.grad is not None
        assert weight.grad.abs().sum() > 0


def test_the_learned_position_map_starts_at_zero_and_tells_places_apart() -> None:
    plain, free = small(), small(decoder_position="learned")
    slots = torch.rand(1, 3, 16)
    free.load_state_dict(plain.state_dict(), strict=False)
    torch.testing.assert_close(free.decode(slots).frames, plain.decode(slots).frames)
    with torch.no_grad():
        free.decoder.position_map[0, :, 2, 5] += 1.0  # type: ignore[index]
    changed = (free.decode(slots).rgb - plain.decode(slots).rgb).abs().amax(dim=(0, 1, 2))
    rows, columns = changed.nonzero(as_tuple=True)
    assert 0 < len(rows) < changed.numel()
    assert rows.float().mean() < columns.float().mean()  # cell (2, 5) of 8 x 8


def test_only_the_pixel_shuffle_decoder_has_a_learned_position_map() -> None:
    with pytest.raises(ValueError, match="decoder_position"):
        small(decoder="broadcast", decoder_position="learned")
