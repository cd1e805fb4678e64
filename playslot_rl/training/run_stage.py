"""A stage is trained: what there is to train, part after part, and one way to carry it out, or to find it finished."""

from __future__ import annotations

import functools
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import nn

from playslot_rl.config import StageConfig
from playslot_rl.data.clips import Clips
from playslot_rl.data.demonstrations import transitions
from playslot_rl.data.tasks import say_missing
from playslot_rl.data.weighted import say_foreign
from playslot_rl.modules.action_range import range_of
from playslot_rl.runtime.processes import here, wait
from playslot_rl.storage.checkpoints import StageCheckpoint
from playslot_rl.storage.resume import sittings_of
from playslot_rl.training.fit import Part, fit, own_checkpoints
from playslot_rl.training.patience import Patience
from playslot_rl.training.record import StageRecord
from playslot_rl.training.stage import ClipStage


@dataclass(frozen=True)
class Training:
    """What a stage that is not finished trains, and what it says of itself afterwards.

    Attributes:
        parts: one after the other; made as they are reached, so that a later one may need an earlier one trained. The
            metrics of all but the first are called after their folder (`decoder_unexplained`).
        device: of their generators.
        line: the closing line, from the metrics.
        extra: more plain values for `meta.json`.
        identity: further plain values that a half-finished stage must share.
        adopt: another run's checkpoint, from which the first part carries on if it is of the same training.
    """

    parts: Iterable[Part]
    device: torch.device
    line: Callable[[Mapping[str, float]], str]
    extra: Mapping[str, Any] = field(default_factory=dict)
    identity: Mapping[str, Any] = field(default_factory=dict)
    adopt: Path | None = None

    def carry_out(self, record: StageRecord, begin: Callable[[], None]) -> StageCheckpoint:
        return _train(record, self, begin)


def on_clips(
    record: StageRecord,
    stage: ClipStage,
    own: StageConfig,
    group: str = "",
    said: Callable[[Mapping[str, float]], str] = lambda metrics: f"{metrics['psnr']:.2f} dB",
    what: str = "clips",
    *,
    patience: Patience | None = None,
    extra: Mapping[str, Any] | None = None,
    identity: Mapping[str, Any] | None = None,
) -> Training:
    """The one part of a model trained on clips, by the settings `group` (empty: `baselines.NAME`); `said` makes the
    closing line's words of its metrics, `what` names what was validated on.
    """
    same = identity or {}
    return Training(
        [Part(group or f"baselines.{record.name}", stage, own, patience=patience, pace=record.pace)],
        record.device,
        lambda metrics: (
            f"{record.name}: {said(defaultdict(lambda: math.nan, metrics))} on {stage.clips.validated} {what}, "
            f"{record.folder}"
        ),
        extra={"episodes": record.data.episodes, **(extra or {}), **same},
        identity=same,
    )


class Prepared(Protocol):
    """What a stage that is not finished trains."""

    def carry_out(self, record: StageRecord, begin: Callable[[], None]) -> StageCheckpoint:
        """Train, carrying on where it was left, and save.

        Args:
            record: what the stage is.
            begin: called before the first step, when nothing speaks against it.
        """


def run_stage(record: StageRecord, prepare: Callable[[], Prepared]) -> StageCheckpoint:
    """Train a stage, carrying on where it was left, and save it; a finished one is said to be skipped.

    Args:
        record: what the stage is.
        prepare: makes what is trained; called only if the stage is not finished.

    Raises:
        CheckpointError: it was begun or finished otherwise.
        OutputError: another command trains it, or as `fit`.
        TrainingError, KeyboardInterrupt: as `fit`.
    """
    done = record.finished()
    wait()  # until all have looked
    if done is not None:
        return done
    if record.role:
        record.say_unlike()
    with record.training() as begin:

        def begun() -> None:
            begin()  # where it can be written
            if record.role:
                say_foreign(record.config.env, record.data, record.roots)
                say_missing(record.videos, record.config.env, record.role == "train")

        return prepare().carry_out(record, begun)


def _ready(begin: Callable[[], None], part: Part) -> None:
    begin()
    if isinstance(clips := getattr(part.stage, "clips", None), Clips):
        clips.say_short()


def _train(record: StageRecord, training: Training, begin: Callable[[], None]) -> StageCheckpoint:
    modules: dict[str, nn.Module] = {}
    metrics: dict[str, float] = {}
    steps, seconds, clocked = 0, 0.0, False
    sittings: list[dict[str, Any]] = []
    limits = record.limits
    if limits is not None and here().first:
        shown = record.data.require_actions()[transitions(record.data).rows]
        print(f"{record.name}: {limits.line(shown)}", flush=True)
    for part in training.parts:
        if limits is not None:
            for known in filter(None, map(range_of, part.stage.modules.values())):
                limits.give(known)
        identity = {**record.resumes(), **training.identity}
        ready = functools.partial(_ready, begin, part)
        if training.adopt is not None and not part.folder:
            ready()
            if here().first:
                own = own_checkpoints(part, record.folder, record.config.seed, identity, record.spec.typed)
                own.take(training.adopt)
            wait()
        state, _ = fit(
            part,
            record.folder,
            seed=record.config.seed,
            device=training.device,
            logging=record.config.logging,
            identity=identity,
            typed=record.spec.typed,
            ready=ready,
        )
        prefix = f"{part.folder}_" if part.folder else ""
        metrics |= {f"{prefix}{key}": value for key, value in state.metrics.items()}
        modules |= part.stage.modules
        steps, seconds = steps or state.step, seconds + state.seconds
        clocked = clocked or state.planned != 0
        sittings += sittings_of(record.folder / part.folder / "checkpoints", part.name)
    extra = {**training.extra, "sittings": sittings, **({"clocked": True} if clocked else {})}
    done = record.save(modules, metrics, steps, seconds, extra)
    print(training.line(metrics), flush=True)
    return done
