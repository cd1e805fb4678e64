"""Plans out of videos: which windows there are, and which is begun with."""

from __future__ import annotations

import torch
from torch import Tensor

from playslot_rl.acting.planners.library import Library, latent_windows

WINDOWS = torch.arange(40.0).view(10, 4, 1)


def test_windows_are_stretches_of_one_video_and_end_in_stillness() -> None:
    a, b = torch.arange(1.0, 11.0)[:, None], torch.arange(100.0, 103.0)[:, None]
    windows = latent_windows([a, b], 8)[..., 0]
    assert windows.shape == (11, 8)  # nine of the first, of whose last two steps are there; two of the second
    for row, first in zip(windows[:9], range(1, 10), strict=True):
        rest = torch.arange(first, min(first + 8, 11.0))
        assert row.tolist() == [*rest.tolist(), *[0.0] * (8 - len(rest))]
    assert windows[9].tolist() == [100.0, 101.0, 102.0, *[0.0] * 5]
    assert windows[10].tolist() == [101.0, 102.0, *[0.0] * 6]


def test_a_video_shorter_than_what_must_be_left_has_one_window() -> None:
    assert latent_windows([torch.ones(1, 2, 3)], 8).shape == (1, 8, 2, 3)


def test_the_cheapest_of_those_that_are_tried_is_taken() -> None:
    seen: list[Tensor] = []

    def cost(windows: Tensor) -> Tensor:
        seen.append(windows)
        return (windows - WINDOWS[6]).abs().sum((1, 2))

    assert torch.equal(Library(WINDOWS, 10).cheapest(cost, torch.Generator().manual_seed(0)), WINDOWS[6:7])
    some = Library(WINDOWS, 3).cheapest(cost, torch.Generator().manual_seed(1))
    assert len(seen[1]) == 3
    assert torch.equal(some[0], seen[1][cost(seen[1]).argmin()])
    again = Library(WINDOWS, 3).cheapest(cost, torch.Generator().manual_seed(1))
    assert torch.equal(some, again)


def test_a_window_without_a_finite_cost_is_not_taken() -> None:
    costs = torch.tensor([float("nan"), float("inf"), *[1.0] * 8])
    found = Library(WINDOWS, 10).cheapest(lambda w: costs[(w[:, 0, 0] / 4).long()], torch.Generator())
    assert float(found[0, 0, 0]) >= 8
