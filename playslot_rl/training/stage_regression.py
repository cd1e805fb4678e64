"""Supervised regression as a stage of `fit`: one network, inputs by row, targets by row.

The oracles, the action decoders and the baselines' latent policies are all trained by it.

Shapes: M rows of training data, b rows of a batch, H W image height and width; inputs and targets have any shape after
their first dimension.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

import numpy as np
import numpy.typing as npt
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from playslot_rl.config import Precision
from playslot_rl.data.device_rows import DeviceRows
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.stream import streams_of
from playslot_rl.losses.behaviour import ActionDecoderLoss, BehaviourLoss
from playslot_rl.runtime.devices import to_device
from playslot_rl.runtime.precision import autocast
from playslot_rl.runtime.processes import spread
from playslot_rl.runtime.shares import own_noise, own_rows
from playslot_rl.seeds.draws import StepGenerators

Observed = Tensor | tuple[Tensor, ...]
"""What a network is called with: one tensor (b, ...), or several."""


class Inputs(Protocol):
    """What a network regresses from, by row."""

    def __len__(self) -> int:
        """M."""

    def draw(self, rows: Tensor, generators: StepGenerators) -> Observed:
        """Inputs (b, ...) of rows int64 (b,), on the CPU, for training, with noise or augmentation drawn from
        `generators`.
        """

    def plain(self, rows: Tensor) -> Observed:
        """Inputs (b, ...) of rows, as they are."""


class TensorInputs:
    """Rows of a tensor (M, ...) on the device that computes, or of several (M_i, ...) that are read as one, which
    nobody holds; with Gaussian noise of that deviation in training, drawn by the generator of that stream.
    """

    def __init__(self, values: Tensor | tuple[Tensor, ...], noise: float = 0.0, stream: str = "noise") -> None:
        self.parts = (values,) if isinstance(values, Tensor) else values
        self.noise, self.stream = noise, stream

    def __len__(self) -> int:
        return sum(len(part) for part in self.parts)

    def draw(self, rows: Tensor, generators: StepGenerators) -> Tensor:
        values = self.plain(rows)
        if self.noise == 0:
            return values
        generator = generators.torch(self.stream, values.device)
        return values + self.noise * own_noise(
            values.shape, lambda shape: torch.randn(shape, generator=generator, device=values.device)
        )

    def plain(self, rows: Tensor) -> Tensor:
        rows = to_device(rows, self.parts[0].device)
        values, start = self.parts[0][rows.clamp(max=len(self.parts[0]) - 1)], len(self.parts[0])
        for part in self.parts[1:]:
            own = (rows >= start) & (rows < start + len(part))
            there = part[(rows - start).clamp(0, len(part) - 1)]
            values = torch.where(own.view(-1, *[1] * (values.dim() - 1)), there, values)
            start += len(part)
        return values


class PairedInputs:
    """Several inputs by row, equally long, for a network that reads more than one."""

    def __init__(self, *parts: Inputs) -> None:
        self.parts = parts

    @classmethod
    def told(cls, observed: Inputs, told: Tensor | None, noise: float = 0.0) -> Inputs:
        """What a policy reads: an observation, and the task (M, 1) or the goal's slots (M, N, D), these with noise in
        training, where it is told.
        """
        if told is None:
            return observed
        return cls(observed, TensorInputs(told, noise if told.is_floating_point() else 0.0, "goal_noise"))

    def __len__(self) -> int:
        return len(self.parts[0])

    def draw(self, rows: Tensor, generators: StepGenerators) -> tuple[Tensor, ...]:
        return tuple(each for part in self.parts for each in _several(part.draw(rows, generators)))

    def plain(self, rows: Tensor) -> tuple[Tensor, ...]:
        return tuple(each for part in self.parts for each in _several(part.plain(rows)))


class FrameInputs:
    """Frames by row: uint8 (b, 3, H, W), [0, 255], in training shifted by so many pixels at most; `rows` are the row
    numbers of the frames, int64 (M,). With (M, F) each input is F frames (b, F, 3, H, W), shifted alike. A GPU keeps
    them where they fit, if they may be `resident`.
    """

    def __init__(
        self,
        source: EpisodeFrames,
        rows: npt.NDArray[np.int64],
        device: torch.device | str,
        shift: int = 0,
        resident: bool = True,
    ) -> None:
        self.rows, self.device, self.shift = rows, torch.device(device), shift
        resident = resident and not streams_of(source.frames)
        self.frames = DeviceRows(lambda own: source.pixels(rows[own]), len(rows), device, resident)

    def __len__(self) -> int:
        return len(self.rows)

    def draw(self, rows: Tensor, generators: StepGenerators) -> Tensor:
        if self.shift == 0:
            return self.plain(rows)
        generator = generators.torch("shift", "cpu")
        offsets = own_noise((len(rows), 2), lambda shape: torch.randint(2 * self.shift + 1, shape, generator=generator))
        frames = self.plain(rows)
        return shifted(frames.flatten(1, -3), to_device(offsets - self.shift, self.device)).view_as(frames)

    def plain(self, rows: Tensor) -> Tensor:
        return self.frames.take(rows)


class TakenInputs:
    """Some rows of inputs, by their numbers int64 (M',)."""

    def __init__(self, inputs: Inputs, rows: Tensor) -> None:
        self.inputs, self.rows = inputs, rows.cpu()

    def __len__(self) -> int:
        return len(self.rows)

    def draw(self, rows: Tensor, generators: StepGenerators) -> Observed:
        return self.inputs.draw(self.rows[rows.cpu()], generators)

    def plain(self, rows: Tensor) -> Observed:
        return self.inputs.plain(self.rows[rows.cpu()])


def shifted(frames: Tensor, offsets: Tensor) -> Tensor:
    """Frames (b, C, H, W), each moved by its own pixels (b, 2), down and right; what enters repeats the edge."""
    height, width = frames.shape[-2:]
    down, right = (
        (torch.arange(size, device=frames.device) - offsets[:, axis, None]).clamp(0, size - 1)
        for axis, size in enumerate((height, width))
    )
    each = torch.arange(len(frames), device=frames.device)[:, None, None]
    return frames.movedim(1, -1)[each, down[:, :, None], right[:, None, :]].movedim(-1, 1)


Examples = tuple[Inputs, Tensor]
"""Inputs, and a target (M, ...) for each of them."""
HELD_OUT = "_held_out"
"""Ends the names of errors on demonstrations beyond those that are trained on."""


class RegressionStage:
    """Regress targets (M, ...) from inputs, rows drawn uniformly with replacement.

    Args:
        name: of the network in checkpoints, and of the generator that draws the rows.
        criterion: compares `criterion.network`'s outputs, trained in place, with the targets.
        checks: what a validation looks at, by the name of the error; the training data as `unexplained` if empty.
        held_out: demonstrations that are not trained on, checked as `unexplained_held_out` where their target is known.
        validated: at most so many rows of each, evenly spread, are looked at in a validation; 0 takes all.
        stream: name of the generator that draws the rows; `name` if empty.
        precision: `bf16` trains the network under autocast (`auto`: where that pays); it is validated in fp32.

    Raises:
        ValueError: numbers of inputs and targets differ.
    """

    def __init__(
        self,
        name: str,
        criterion: BehaviourLoss | ActionDecoderLoss,
        inputs: Inputs,
        targets: Tensor,
        batch_size: int,
        *,
        checks: Mapping[str, Examples] | None = None,
        held_out: Examples | None = None,
        validated: int = 0,
        stream: str = "",
        precision: Precision = "fp32",
    ) -> None:
        if len(inputs) != len(targets):
            raise ValueError(f"{name}: got {len(targets)} targets, expected one for each of {len(inputs)} inputs")
        self.name, self.criterion, self.stream = name, criterion, stream or name
        self.inputs, self.targets, self.batch_size, self.validated = inputs, targets, batch_size, validated
        self.precision = precision
        self.checks = dict(checks or {"unexplained": (inputs, targets)})
        if held_out is not None and len((known := _with_targets(*held_out))[1]):
            self.checks[f"unexplained{HELD_OUT}"] = known

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        return {self.name: self.criterion.network}

    def batch(self, step: int, generators: StepGenerators) -> Mapping[str, Tensor]:  # noqa: ARG002
        drawn = torch.randint(len(self.targets), (self.batch_size,), generator=generators.torch(self.stream, "cpu"))
        rows = own_rows(drawn)
        observed = dict(zip(self.criterion.observed, _several(self.inputs.draw(rows, generators)), strict=True))
        return {**observed, self.criterion.tensor_keys.action: self.targets[to_device(rows, self.targets.device)]}

    def loss(self, batch: Mapping[str, Tensor], step: int, generators: StepGenerators) -> Mapping[str, Tensor]:  # noqa: ARG002
        with autocast(self.targets.device.type, self.precision):
            losses = self.criterion(TensorDict(dict(batch)))
        return {"loss": losses[self.criterion.out_name]}

    def validate(self, step: int) -> Mapping[str, float]:  # noqa: ARG002
        """Unexplained fraction of the targets' variance, of each of the checks."""
        return {name: unexplained(*self.compared(*examples)) for name, examples in self.checks.items()}

    def compared(self, inputs: Inputs, targets: Tensor) -> tuple[Tensor, Tensor]:
        """The network's outputs, and the targets, on those of some examples that a validation looks at."""
        count = min(self.validated or len(targets), len(targets))
        rows = torch.linspace(0, len(targets) - 1, count, device=targets.device).long()
        return apply_rows(self.criterion.network, inputs, rows), targets[rows]


def _with_targets(inputs: Inputs, targets: Tensor) -> Examples:
    """Those whose target is known: demonstrations without actions, beside others that have some, have NaN."""
    known = ~targets.flatten(1).isnan().any(dim=1)
    return (inputs, targets) if known.all() else (TakenInputs(inputs, known.nonzero()[:, 0]), targets[known])


def together(batches: Mapping[str, Mapping[str, Tensor]]) -> dict[str, Tensor]:
    """Batches of several stages, by name, as one; `apart` gives one of them back."""
    return {f"{name}/{key}": value for name, batch in batches.items() for key, value in batch.items()}


def apart(batch: Mapping[str, Tensor], name: str) -> dict[str, Tensor]:
    """The batch of that name in what `together` made."""
    return {key.removeprefix(f"{name}/"): value for key, value in batch.items() if key.startswith(f"{name}/")}


@torch.no_grad()
def apply_rows(network: Callable[..., Tensor], inputs: Inputs, rows: Tensor, batch: int = 1024) -> Tensor:
    """A network's outputs (b, ...) on rows of its inputs, in the mode it is in."""
    parts = spread(rows.split(batch), lambda _, part: network(*_several(inputs.plain(part))))
    return torch.cat(parts).to(rows.device)


def _several(observed: Observed) -> tuple[Tensor, ...]:
    return observed if isinstance(observed, tuple) else (observed,)


def unexplained(predicted: Tensor, target: Tensor) -> float:
    """Fraction of the targets' variance that predictions leave unexplained (1 - R^2, pooled over dimensions)."""
    spread = (target - target.mean(dim=0)).square().sum().clamp(min=1e-12)
    return float((predicted - target).square().sum() / spread)
