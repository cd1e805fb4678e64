"""Mutual information of the actions in real and in generated frames."""

from __future__ import annotations

import math

import pytest
import torch

from playslot_rl.methods.caddy.action import ActionInformation, joint_distribution, mutual_information


def random_p(rows: int, actions: int, seed: int) -> torch.Tensor:
    return (3 * torch.randn(rows, actions, generator=torch.Generator().manual_seed(seed))).softmax(dim=-1)


@pytest.mark.parametrize("actions", [2, 5, 8])
def test_equal_actions_that_are_all_used_alike_have_log_k(actions: int) -> None:
    p = torch.eye(actions).repeat(3, 1)
    assert mutual_information(joint_distribution(p, p)).item() == pytest.approx(math.log(actions), abs=1e-5)


def test_one_action_for_everything_has_none() -> None:
    p = torch.zeros(9, 4)
    p[:, 2] = 1
    assert mutual_information(joint_distribution(p, p)).item() == pytest.approx(0, abs=1e-6)


def test_independent_actions_have_none() -> None:
    marginal = torch.tensor([0.1, 0.2, 0.7])
    assert mutual_information(torch.outer(marginal, marginal)).item() == pytest.approx(0, abs=1e-6)
    p, q = torch.eye(3).repeat_interleave(3, dim=0), torch.eye(3).repeat(3, 1)
    assert mutual_information(joint_distribution(p, q)).item() == pytest.approx(0, abs=1e-6)


def test_hesitant_actions_have_less_than_decided_ones() -> None:
    decided, hesitant = torch.eye(4), 0.6 * torch.eye(4) + 0.1
    values = [float(mutual_information(joint_distribution(p, p))) for p in (hesitant, decided)]
    assert 0 < values[0] < values[1]


@pytest.mark.parametrize("seed", range(5))
def test_the_information_is_between_zero_and_log_k_and_symmetric(seed: int) -> None:
    p, q = random_p(6, 4, seed), random_p(6, 4, seed + 100)
    joint = joint_distribution(p, q)
    assert torch.equal(joint, joint.T)
    assert joint.sum().item() == pytest.approx(1, abs=1e-5)
    value = float(mutual_information(joint))
    assert -1e-6 <= value <= math.log(4)
    assert value == pytest.approx(float(mutual_information(joint_distribution(q, p))), abs=1e-6)


def test_the_average_begins_with_the_first_batch_and_then_keeps_a_part_of_the_old() -> None:
    information = ActionInformation(4, decay=0.8)
    p, q = random_p(6, 4, 0), random_p(6, 4, 1)
    value = information(p, p)
    torch.testing.assert_close(information.joint, joint_distribution(p, p))
    torch.testing.assert_close(value, mutual_information(joint_distribution(p, p)))
    value = information(p, q)
    expected = 0.8 * joint_distribution(p, p) + 0.2 * joint_distribution(p, q)
    torch.testing.assert_close(information.joint, expected)
    torch.testing.assert_close(value, mutual_information(expected))


def test_the_average_moves_in_training_mode_only_and_is_stored() -> None:
    information = ActionInformation(4, decay=0.8)
    information(random_p(6, 4, 0), random_p(6, 4, 1))
    before = information.joint.clone()
    information.eval()(random_p(6, 4, 2), random_p(6, 4, 3))
    assert torch.equal(information.joint, before)
    assert {"joint", "updates"} <= information.state_dict().keys()


def test_no_pairs_of_frames_have_no_information_and_move_nothing() -> None:
    information = ActionInformation(4, decay=0.8)
    assert information(torch.zeros(2, 0, 4), torch.zeros(2, 0, 4)) == 0
    assert information.updates == 0


def test_gradients_are_finite_for_one_hot_actions_and_raise_the_information() -> None:
    logits = torch.zeros(8, 4, requires_grad=True)
    hard = torch.eye(4).repeat(2, 1).requires_grad_()
    mutual_information(joint_distribution(hard, hard)).backward()
    assert hard.grad is not None
    assert hard.grad.isfinite().all()
    with torch.no_grad():
        logits.normal_(generator=torch.Generator().manual_seed(0))
    first = mutual_information(joint_distribution(logits.softmax(-1), logits.softmax(-1)))
    first.backward()
    assert logits.grad is not None
    with torch.no_grad():
        moved = (logits + logits.grad).softmax(-1)
        assert mutual_information(joint_distribution(moved, moved)) > first
