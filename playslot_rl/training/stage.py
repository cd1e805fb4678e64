"""What `fit` asks of a stage."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt
from torch import Tensor, nn

from playslot_rl.data.clips import Clips
from playslot_rl.seeds.draws import StepGenerators


class Stage(Protocol):
    """What a stage gives to `fit`. It keeps no state of its own between steps, except in its modules."""

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        """What is trained and stored, by name; parameters without `requires_grad` are stored, not trained."""

    def batch(self, step: int, generators: StepGenerators) -> Mapping[str, Tensor]:
        """What a step computes from: tensors on the device, of the same shapes in all steps of a phase.

        Rows are drawn for the whole batch and passed through `playslot_rl.runtime.shares.own_rows`. All randomness
        comes from `generators`.
        """

    def loss(self, batch: Mapping[str, Tensor], step: int, generators: StepGenerators) -> Mapping[str, Tensor]:
        """Scalars of one step; `loss` is minimised, the others are logged.

        Computed on the device without waiting for it, so that it can be captured: noise is drawn by `own_noise`, what
        is no mean over the rows is computed from `all_rows`, and nothing branches on values.
        """

    def validate(self, step: int) -> Mapping[str, float]:
        """Numbers on held-out data after `step` steps; called without gradients, modules in eval mode. What takes long
        is shared out by `playslot_rl.runtime.processes.spread`.
        """


class ClipStage(Stage, Protocol):
    """A `Stage` on clips, which say what it is validated on."""

    clips: Clips


def step_loss(stage: Stage, step: int, generators: StepGenerators) -> Mapping[str, Tensor]:
    """The loss of a stage on the batch of a step."""
    return stage.loss(stage.batch(step, generators), step, generators)


@runtime_checkable
class WatchedStage(Protocol):
    """A `Stage` whose validations can also be looked at. Nothing of this changes what is learned."""

    def warnings(self, step: int, values: Mapping[str, float]) -> Mapping[str, str]:
        """What the numbers of the validation after `step` steps say is wrong, by kind: one line each, with a cure."""

    def pictures(self, step: int) -> Mapping[str, npt.NDArray[np.uint8]]:
        """Pictures (H, W, 3) of held-out data, by name; called like `validate`, where a logger shows pictures."""


@runtime_checkable
class PhasedStage(Protocol):
    """A `Stage` whose loss computes something else at some steps."""

    def phase(self, step: int) -> Hashable:
        """Equal for steps that compute the same from their batch; None where every step differs and none can be
        captured.
        """


@runtime_checkable
class SeparateStage(Protocol):
    """A `Stage` of several networks that share nothing: `separate` is True, and none changes what another learns."""

    separate: bool
