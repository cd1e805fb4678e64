"""Steps as a graph takes them, on a CPU."""

from __future__ import annotations

from collections.abc import Callable
from unittest.mock import patch

import torch
from torch import Tensor

from playslot_rl.training.steps import Steps


class Replayed(Steps):
    """What is recorded is one step's own call, and nothing of a later step reaches it but the buffers. So a number that
    a stage reads elsewhere is that of the recorded step for ever."""

    replays = 0

    def _captures(self) -> bool:
        return True

    def _recorded(self, compute: Callable[[], dict[str, Tensor]]) -> Callable[[], None] | None:
        def replay() -> None:
            type(self).replays += 1
            with patch.object(torch, "Generator", side_effect=AssertionError("a generator was made in a replay")):
                self._values = compute()

        return replay


def different(one: dict[str, Tensor], other: dict[str, Tensor]) -> set[str]:
    return {key for key in one if not torch.equal(one[key], other[key])}
