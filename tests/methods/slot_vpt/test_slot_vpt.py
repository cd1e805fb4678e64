"""VPT on slots: what stands in for labels, and what it is told from."""

from __future__ import annotations

import pytest
import torch

from playslot_rl.config import PolicyConfig
from playslot_rl.config.compose import compose
from playslot_rl.methods.slot_vpt.training import Changes, labeller_stage, pseudo_labels
from playslot_rl.modules.policy import LatentPolicy
from playslot_rl.seeds.draws import StepGenerators

SIZES = PolicyConfig(dim=16, layers=1, heads=2, head_dim=8, mlp_dim=16)


@pytest.fixture
def labeller() -> LatentPolicy:
    torch.manual_seed(0)
    return LatentPolicy(SIZES, 2 * 6, 3)


@pytest.fixture
def seen() -> Changes:
    """Two transitions of each of four demonstrations, five slots."""
    generator = torch.Generator().manual_seed(1)
    slots, change = torch.randn(2, 8, 5, 6, generator=generator)
    actions = torch.rand(8, 3, generator=generator) * 2 - 1
    return Changes(slots, change, actions, torch.arange(4).repeat_interleave(2), None)


def test_real_actions_stay_where_they_are_labelled_and_no_others_are_read(
    labeller: LatentPolicy, seen: Changes
) -> None:
    said = pseudo_labels(labeller, seen, seen.scale(), 2)
    assert torch.equal(said[:4], seen.actions[:4])
    unknown = seen._replace(actions=torch.where((seen.episode < 2)[:, None], seen.actions, torch.nan))
    assert torch.equal(pseudo_labels(labeller, unknown, unknown.scale(), 2), said)


def test_what_stands_in_is_an_action(labeller: LatentPolicy, seen: Changes) -> None:
    labeller.head.bias.data.fill_(9.0)
    assert torch.equal(pseudo_labels(labeller, seen, seen.scale(), 2)[4:], torch.ones(4, 3))


def test_the_labeller_tells_one_change_from_its_opposite_and_knows_no_order_of_slots(
    labeller: LatentPolicy, seen: Changes
) -> None:
    one = torch.ones(())
    said = labeller(seen.pairs(one))
    torch.testing.assert_close(labeller(seen.pairs(one)[:, [3, 0, 4, 1, 2]]), said)
    assert not torch.allclose(labeller(seen._replace(change=-seen.change).pairs(one)), said)


def test_changes_count_by_how_much_they_vary(labeller: LatentPolicy, seen: Changes) -> None:
    small = seen._replace(change=seen.change / 100)
    torch.testing.assert_close(
        pseudo_labels(labeller, small, small.scale(), 2), pseudo_labels(labeller, seen, seen.scale(), 2)
    )


def test_a_set_in_which_nothing_changes_is_labelled(labeller: LatentPolicy, seen: Changes) -> None:
    still = seen._replace(change=torch.zeros_like(seen.change))
    assert pseudo_labels(labeller, still, still.scale(), 2).isfinite().all()


def test_the_labeller_learns_from_the_labelled_demonstrations_alone(labeller: LatentPolicy, seen: Changes) -> None:
    config = compose(["behaviour.labelled_demos=1", "behaviour.slot_noise=0", "behaviour.batch_size=32"])
    stage = labeller_stage(labeller, seen, seen.scale(), config.behaviour, None)
    batch = stage.batch(0, StepGenerators(0, 0))
    rows = {tuple(row.tolist()) for row in seen.actions[:2]}
    assert {tuple(row.tolist()) for part in batch.values() for row in part if row.shape == (3,)} == rows
