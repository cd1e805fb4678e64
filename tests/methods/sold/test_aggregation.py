"""The slot-aggregation transformer: causal, blind to the order of slots, positions by ALiBi alone."""

from __future__ import annotations

import pytest
import torch

from playslot_rl.methods.sold.networks import SlotAggregation, alibi_bias, alibi_slopes


@pytest.fixture
def model() -> SlotAggregation:
    torch.manual_seed(0)
    return SlotAggregation(slot_dim=6, dim=16, layers=2, heads=4, mlp_dim=32)


def test_slopes_are_the_geometric_sequence_of_the_alibi_paper() -> None:
    assert alibi_slopes(8).tolist() == [2.0**-k for k in range(1, 9)]
    assert alibi_slopes(4).tolist() == [2.0**-2, 2.0**-4, 2.0**-6, 2.0**-8]


def test_the_bias_counts_steps_not_tokens_and_hides_later_steps() -> None:
    bias = alibi_bias(torch.tensor([0.5]), new=2, past=1, tokens=2)[0]
    inf = float("inf")
    assert bias.tolist() == [
        [-0.5, -0.5, 0.0, 0.0, -inf, -inf],
        [-0.5, -0.5, 0.0, 0.0, -inf, -inf],
        [-1.0, -1.0, -0.5, -0.5, 0.0, 0.0],
        [-1.0, -1.0, -0.5, -0.5, 0.0, 0.0],
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


def test_only_distances_matter_so_a_window_may_slide(model: SlotAggregation) -> None:
    """With one layer, what lies before the window is all that is missing; its own frames look the same."""
    shifted = alibi_bias(model.slopes, new=3, past=4, tokens=2)[:, :, 8:]
    assert torch.equal(shifted, alibi_bias(model.slopes, new=3, past=0, tokens=2))


def test_heads_that_do_not_divide_the_width_are_refused() -> None:
    with pytest.raises(ValueError, match="heads: got 3, expected a divisor of dim 16"):
        SlotAggregation(slot_dim=6, dim=16, layers=1, heads=3, mlp_dim=32)
