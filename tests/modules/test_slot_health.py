"""Slot health against closed forms."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from playslot_rl.modules.savi.health import SlotHealth, exchanges, held_share, mask_entropy, owners


def masks_of(labels: Tensor, n: int) -> Tensor:
    """One-hot masks (B, T, N, 1, H, W) of labels (B, T, H, W)."""
    return torch.nn.functional.one_hot(labels, n).movedim(-1, 2).unsqueeze(3).float()


def quarters() -> Tensor:
    """(4, 4) labels: each of four slots holds a quarter."""
    return torch.arange(4).reshape(2, 2).repeat_interleave(2, 0).repeat_interleave(2, 1)


def clip(*permutations: tuple[int, ...]) -> Tensor:
    """(1, T, 4, 4): the quarters, renamed in each frame."""
    return torch.stack([torch.tensor(names)[quarters()] for names in permutations])[None]


STAY = (0, 1, 2, 3)


@pytest.mark.parametrize("n", [2, 4, 7])
def test_entropy_is_zero_of_one_hot_masks_and_log_n_of_uniform_ones(n: int) -> None:
    assert float(mask_entropy(masks_of(torch.zeros(1, 2, 4, 4, dtype=torch.long), n))) == 0.0
    assert float(mask_entropy(torch.full((1, 2, n, 1, 4, 4), 1 / n))) == pytest.approx(math.log(n), rel=1e-5)


def test_slots_that_keep_their_things_do_not_flicker_and_each_exchange_counts_once() -> None:
    labels = clip(STAY, STAY, (1, 0, 2, 3), (1, 0, 3, 2), (0, 1, 2, 3), (1, 2, 3, 0))
    assert exchanges(labels, 4).tolist() == [[0, 1, 1, 2, 3]]


def test_a_thing_that_moves_in_its_slot_is_no_exchange() -> None:
    labels = torch.zeros(1, 3, 8, 8, dtype=torch.long)
    for t in range(3):
        labels[0, t, 2:4, 2 * t : 2 * t + 2] = 1  # the places do not even overlap
    assert exchanges(labels, 3).tolist() == [[0, 0]]


def test_owners_take_the_largest_mask_and_shares_add_up() -> None:
    labels = clip(STAY, (1, 0, 2, 3))
    assert torch.equal(owners(masks_of(labels, 4)), labels)
    assert held_share(labels, 4).tolist() == [[0.25] * 4]


def health_of(labels: Tensor, n: int, frames: Tensor | None = None, drawn: Tensor | None = None) -> dict[str, float]:
    health = SlotHealth(n)
    still = torch.zeros(*labels.shape[:2], 3, *labels.shape[2:])
    health.add(still if frames is None else frames, still if drawn is None else drawn, masks_of(labels, n))
    return health.values()


def test_one_slot_that_holds_everything_is_seen() -> None:
    values = health_of(torch.zeros(2, 3, 8, 8, dtype=torch.long), 4)
    assert (values["slots_in_use"], values["largest_slot"], values["flicker"]) == (1.0, 1.0, 0.0)
    assert health_of(clip(STAY, STAY), 4)["slots_in_use"] == 4.0


def test_motion_explained_is_all_of_it_none_of_it_or_half() -> None:
    labels = torch.zeros(1, 2, 8, 8, dtype=torch.long)
    frames = torch.zeros(1, 2, 3, 8, 8)
    frames[0, 1, :, :2] = 0.8
    for factor, explained in ((1.0, 1.0), (0.0, 0.0), (0.5, 0.75)):  # 1 - (1 - factor)^2
        assert health_of(labels, 2, frames, factor * frames)["moving_explained"] == pytest.approx(explained)


def test_where_nothing_moves_no_motion_is_explained_and_one_frame_has_no_flicker() -> None:
    assert "moving_explained" not in health_of(clip(STAY, STAY), 4)
    assert "flicker" not in health_of(clip(STAY), 4)


def test_batches_count_by_their_clips() -> None:
    health, still = SlotHealth(4), torch.zeros(1, 2, 3, 4, 4)
    for labels in (clip(STAY, STAY), clip(STAY, (1, 0, 2, 3)), clip(STAY, STAY), clip(STAY, STAY)):
        health.add(still, still, masks_of(labels, 4))
    assert health.values()["flicker"] == 0.25
