"""The slot-aggregation transformer: causal, blind to the order of slots, positions by ALiBi alone."""

from __future__ import annotations

import pytest
import torch

from playslot_rl.methods.sold.aggregation import SlotAggregation, alibi_bias, alibi_slopes


@pytest.fixture
def model() -> SlotAggregation:
    torch.manual_seed(0)
    return SlotAggregation(slot_dim=6, dim=16, layers=2, heads=4, mlp_dim=32)


def test_slopes_are_the_geometric_sequence_of_the_source() -> None:
    torch.testing.assert_close(alibi_slopes(8), torch.tensor([2.0 ** (-k / 2) for k in range(1, 9)]))
    assert alibi_slopes(4).tolist() == [2.0**-1, 2.0**-2, 2.0**-3, 2.0**-4]


def test_the_bias_counts_steps_not_tokens_and_hides_later_steps_and_earlier_outputs() -> None:
    bias = alibi_bias(torch.tensor([0.5]), new=2, past=1, slots=1)[0]
    inf = float("inf")
    assert bias.tolist() == [
        [-0.5, 0.0, 0.0, -inf, -inf],
        [-0.5, 0.0, 0.0, -inf, -inf],
        [-1.0, -0.5, -inf, 0.0, 0.0],
        [-1.0, -0.5, -inf, 0.0, 0.0],
    ]


def test_no_output_depends_on_a_later_step(model: SlotAggregation) -> None:
    slots = torch.randn(2, 5, 3, 6, requires_grad=True)
    for t in range(5):
        (gradient,) = torch.autograd.grad(model(slots)[0][:, t, 0].sum(), slots)
        assert gradient[:, t + 1 :].abs().sum() == 0
        assert (gradient[:, : t + 1].abs().sum(dim=(0, 2, 3)) > 0).all()  # and on every earlier one it does


def test_the_order_of_slots_does_not_matter_at_any_step(model: SlotAggregation) -> None:
    slots = torch.randn(2, 4, 3, 6)
    shuffled = slots.clone()
    for t, order in enumerate(([2, 0, 1], [0, 2, 1], [1, 2, 0], [2, 1, 0])):
        shuffled[:, t] = slots[:, t, order]
    torch.testing.assert_close(model(shuffled)[0], model(slots)[0])


def test_it_depends_on_the_order_of_steps(model: SlotAggregation) -> None:
    slots = torch.randn(1, 4, 3, 6)
    swapped = slots[:, [1, 0, 2, 3]]
    assert (model(swapped)[0][:, -1] - model(slots)[0][:, -1]).abs().max() > 1e-5


def test_step_by_step_with_kept_keys_equals_one_pass(model: SlotAggregation) -> None:
    slots = torch.randn(2, 6, 3, 6)
    whole, _ = model(slots)
    first, past = model(slots[:, :2])
    parts = [first]
    for t in range(2, 6):
        out, past = model(slots[:, t : t + 1], past)
        parts.append(out)
    torch.testing.assert_close(torch.cat(parts, dim=1), whole)


@torch.no_grad()
def test_frame_by_frame_with_episodes_of_any_age_equals_one_pass(model: SlotAggregation) -> None:
    slots, ages = torch.randn(3, 7, 4, 6), torch.tensor([0, 2, 5])
    whole, _ = model(slots)
    kept = model.blank(3, 7, 4)
    for t in range(5):  # the others are ahead
        ahead = ages > t
        kept[ahead] = model.step(slots[ahead, t], kept[ahead], torch.full((int(ahead.sum()),), t))[1]
    for t in range(2):
        summary, kept = model.step(slots[torch.arange(3), ages + t], kept, ages + t)
        torch.testing.assert_close(summary, whole[torch.arange(3), ages + t])


def test_kept_keys_and_values_carry_the_gradient_of_one_pass(model: SlotAggregation) -> None:
    slots = torch.randn(2, 5, 3, 6)
    whole, _ = model(slots)
    first, past = model(slots[:, :2])
    rest, _ = model(slots[:, 2:], past)
    for parameter in model.parameters():
        wanted, got = (
            torch.autograd.grad(each[:, -1].sum(), parameter, retain_graph=True)[0] for each in (whole, rest)
        )
        torch.testing.assert_close(got, wanted, atol=1e-5, rtol=1e-4)
    assert first.shape == (2, 2, 16)


def test_heads_that_do_not_divide_the_width_are_refused() -> None:
    with pytest.raises(ValueError, match="heads: got 3, expected a divisor of dim 16"):
        SlotAggregation(slot_dim=6, dim=16, layers=1, heads=3, mlp_dim=32)
