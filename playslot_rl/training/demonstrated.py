"""What the stages that clone demonstrations share: their slots, and what is said of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from playslot_rl.config import ExperimentConfig
from playslot_rl.data.cache import Cache
from playslot_rl.data.demonstrations import (
    DemonstrationSplit,
    Transitions,
    ends_in,
    moving_slots,
    real_actions,
    transitions,
)
from playslot_rl.data.slot_cache import slot_cache
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.tasks import told_tasks
from playslot_rl.data.views import shifted_copies
from playslot_rl.modules.savi import SAVi
from playslot_rl.training.fit import Part
from playslot_rl.training.record import StageRecord
from playslot_rl.training.run_stage import Training
from playslot_rl.world_model import module_device, require_slots

ParsedVideos = tuple[EpisodeFrames, npt.NDArray[np.float32]]


def demonstration_views(
    config: ExperimentConfig, demos: DemonstrationSplit, savi: SAVi, slots_print: str
) -> tuple[list[ParsedVideos], list[ParsedVideos]]:
    """Demonstrations and their shifted copies (`behaviour.shift`), each with the slots (F, N, D) of its frames, and the
    held-out ones, none or one, likewise; cached on disk by the fingerprint of SAVi's checkpoint. A ConfigError where
    the policy is to see slots that SAVi has not.
    """
    require_slots(config.model.policy, savi.config)

    def parse(frames: EpisodeFrames) -> npt.NDArray[np.float32]:
        return slot_cache(
            frames, savi, slots_print, Cache.of(config.data), module_device(savi), config.logging.progress
        )

    def copies(of: EpisodeFrames) -> Sequence[EpisodeFrames]:
        return shifted_copies(of, config.behaviour.shift, config.behaviour.shifted_copies)

    shifted_views = [(copy, parse(of)) for copy, of in zip(copies(demos.trained), copies(demos.parsed), strict=True)]
    held_out = [] if demos.held_out is None else [(demos.held_out, parse(demos.held_out))]
    return [(demos.trained, parse(demos.parsed)), *shifted_views], held_out


class Moves(NamedTuple):
    """Transitions of demonstrations in which slots move: their slots (M, N, D), real actions (M, A), and what a policy
    is told of what to do: which of several tasks, int64 (M, 1), or the slots in which each ends (M, N, D); and where
    they are among the frames of each view.
    """

    slots: Tensor
    actions: Tensor
    told: Tensor | None
    found: list[Transitions]


def moves(views: list[ParsedVideos], config: ExperimentConfig, device: torch.device) -> Moves:
    """What a policy that clones real actions learns from: trimmed by `behaviour.trim`."""
    own, env = config.behaviour, config.env
    found = [moving_slots(transitions(frames), slots, own.trim, own.trim_margin) for frames, slots in views]
    pairs = list(zip(views, found, strict=True))
    told = [each for (frames, _), moving in pairs if (each := told_tasks(frames, moving, env)) is not None]
    if config.model.policy.goal:
        told = [ends_in(frames, slots, moving) for (frames, slots), moving in pairs]
    return Moves(
        torch.cat([torch.from_numpy(slots[moving.rows]) for (_, slots), moving in pairs]).to(device),
        torch.cat([real_actions(frames, moving.rows, env.action_dim) for (frames, _), moving in pairs]).to(device),
        torch.cat(told).to(device) if told else None,
        found,
    )


def policy_taken_over(config: ExperimentConfig, record: StageRecord, steps: int) -> Path | None:
    """Where the run that `behaviour.policy_from` names has its finished policy training; None where it names none."""
    source = config.behaviour.policy_from
    return Path(source) / record.name / "checkpoints" / f"step_{steps:08d}" if source else None


def _without_actions(source: EpisodeFrames) -> str:
    """How many of some demonstrations have none, where others do, for a line."""
    silent = len(np.unique(source.numbers[source.silent]))
    return f" ({silent} without actions)" if silent else ""


def cloned(
    name: str, split: DemonstrationSplit, rows: int, labelled: int | None = None, views: int = 1
) -> tuple[str, dict[str, Any]]:
    """What a stage that clones demonstrations says of them: its closing line, less its folder, and for `meta.json`.

    Args:
        split: the demonstrations; those of one frame show nothing and are not counted.
        rows: how many of their rows trimming left.
        labelled: how many of them showed their actions; None: all.
        views: shifted copies that were cloned with them, and they themselves.
    """
    trained = split.trained
    demos = len(np.unique(trained.numbers[trained.lengths >= 2]))
    kept = rows / (views * int((trained.lengths - 1).sum()))
    shown = "all" if labelled is None else str(labelled)
    held_out = "none" if split.held_out is None else str(split.held_out.recordings)
    silent = "" if split.held_out is None else _without_actions(split.held_out)
    line = (
        f"{name}: {demos} demos, {100 * kept:.0f} % of their rows kept, {shown} labelled, {held_out} held out{silent}"
    )
    return line, {
        "demos": demos,
        "labelled_demos": demos if labelled is None else labelled,
        "kept_rows": round(kept, 4),
    }


def cloning_alone(
    record: StageRecord,
    part: Part,
    rows: int,
    said: str = "",
    facts: Mapping[str, Any] | None = None,
    labelled: int | None = None,
    views: int = 1,
) -> Training:
    """The training of a stage that clones demonstrations in one part: `rows`, `labelled` and `views` as in `cloned`;
    `said` ends its closing line, and `facts` are for `meta.json` and of its identity.
    """
    line, known = cloned(record.name, record.demos, rows, labelled, views)
    facts = facts or {}
    return Training(
        [part], record.device, lambda _: f"{line}{said}, {record.folder}", extra={**known, **facts}, identity=facts
    )
