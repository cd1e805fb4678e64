"""What `fit` asks of a stage."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt
from torch import Tensor, nn

from playslot_rl.seeds.draws import StepGenerators


class Stage(Protocol):
    """What a stage gives to `fit`. It keeps no state of its own between steps, except in its modules."""

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        """What is trained and stored, by name; parameters without `requires_grad` are stored, not trained."""

    def loss(self, step: int, generators: StepGenerators) -> Mapping[str, Tensor]:
        """Scalars of one step; `loss` is minimised, the others are logged. All randomness comes from `generators`.

        Rows are drawn for the whole batch and passed through `playslot_rl.runtime.shares.own_rows`, noise is drawn by
        `own_noise`, and what is no mean over the rows is computed from `all_rows`.
        """

    def validate(self, step: int) -> Mapping[str, float]:
        """Numbers on held-out data after `step` steps; called without gradients, modules in eval mode. What takes long
        is shared out by `playslot_rl.runtime.processes.spread`.
        """


@runtime_checkable
class WatchedStage(Protocol):
    """A `Stage` whose validations can also be looked at. Nothing of this changes what is learned."""

    def warnings(self, step: int, values: Mapping[str, float]) -> Mapping[str, str]:
        """What the numbers of the validation after `step` steps say is wrong, by kind: one line each, with a cure."""

    def pictures(self, step: int) -> Mapping[str, npt.NDArray[np.uint8]]:
        """Pictures (H, W, 3) of held-out data, by name; called like `validate`, where a logger shows pictures."""
