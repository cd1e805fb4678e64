"""OCVP-Seq with an action token: causal, equivariant to the order of slots, and its rollout."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from playslot_rl.modules.predictors.ocvp_seq import OCVPSeq


@pytest.fixture
def model() -> OCVPSeq:
    torch.manual_seed(0)
    made = OCVPSeq(slot_dim=6, action_dim=2, dim=16, layers=2, heads=4, mlp_dim=32, context=8)
    nn.init.normal_(made.head.weight, std=0.3)  # it starts at zero, which would pass every test below
    return made


def _data(steps: int = 5) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    return torch.randn(2, steps, 3, 6, generator=generator), torch.rand(2, steps, 2, generator=generator) * 2 - 1


def test_untrained_it_predicts_that_nothing_moves() -> None:
    slots, actions = _data()
    fresh = OCVPSeq(slot_dim=6, action_dim=2, dim=16, layers=1, heads=2, mlp_dim=32, context=8)
    torch.testing.assert_close(fresh(slots, actions)[0], slots)


def test_a_prediction_depends_on_this_and_earlier_frames_and_actions_only(model: OCVPSeq) -> None:
    slots, actions = _data()
    slots.requires_grad_()
    actions.requires_grad_()
    for t in range(5):
        by_slots, by_actions = torch.autograd.grad(model(slots, actions)[0][:, t].square().sum(), (slots, actions))
        for gradient in (by_slots.flatten(2), by_actions):
            assert gradient[:, t + 1 :].abs().sum() == 0
            assert (gradient[:, : t + 1].abs().sum(dim=(0, 2)) > 0).all()


def test_every_slot_depends_on_the_action_and_on_the_other_slots(model: OCVPSeq) -> None:
    slots, actions = _data(1)
    slots.requires_grad_()
    actions.requires_grad_()
    for n in range(3):
        by_slots, by_actions = torch.autograd.grad(model(slots, actions)[0][:, 0, n].square().sum(), (slots, actions))
        assert by_actions.abs().min() > 0
        assert (by_slots.abs().sum(dim=(0, 1, 3)) > 0).all()


def test_slots_in_another_order_give_the_predictions_in_that_order(model: OCVPSeq) -> None:
    slots, actions = _data()
    order = [2, 0, 1]
    torch.testing.assert_close(model(slots[:, :, order], actions)[0], model(slots, actions)[0][:, :, order])


def test_the_rollout_equals_computing_every_step_anew(model: OCVPSeq) -> None:
    slots, actions = _data(7)
    seed = slots[:, :3]
    frames = seed
    for t in range(2, 7):
        following = model(frames, actions[:, : t + 1])[0]
        frames = torch.cat((frames, following[:, -1:]), dim=1)
    expected = torch.cat((model(seed, actions[:, :3])[0][:, :2], frames[:, 3:]), dim=1)
    torch.testing.assert_close(model.rollout(seed, actions), expected)


def test_gradients_of_the_rollout_equal_those_of_computing_every_step_anew(model: OCVPSeq) -> None:
    slots, actions = _data(5)
    weights = list(model.parameters())
    kept = torch.autograd.grad(model.rollout(slots[:, :2], actions).square().mean(), weights)
    frames, predicted = slots[:, :2], [model(slots[:, :2], actions[:, :2])[0]]
    for t in range(1, 5):
        out = model(frames, actions[:, : t + 1])[0][:, -1:]
        frames = torch.cat((frames, out), dim=1)
        predicted.append(out)
    anew = torch.autograd.grad(torch.cat((predicted[0][:, :1], *predicted[1:]), dim=1).square().mean(), weights)
    for a, b in zip(kept, anew, strict=True):
        torch.testing.assert_close(a, b, atol=1e-6, rtol=1e-4)


def test_more_frames_than_it_has_codes_for_are_refused(model: OCVPSeq) -> None:
    slots, actions = _data(9)
    with pytest.raises(ValueError, match="frames: got 9, expected at most 8"):
        model(slots, actions)
