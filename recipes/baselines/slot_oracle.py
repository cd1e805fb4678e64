"""`playslot train-baseline method=slot_oracle run=WORLD data.demos=DEMOS out=DIR`: clone real actions from slots.

Sizes are `model.policy`, the schedule is `behaviour`, as for PlaySlot's policy.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

from playslot_rl.config import ExperimentConfig
from playslot_rl.recipes.run import open_device, open_run, parent_run, require_parent

if TYPE_CHECKING:
    from torch import Tensor

    from playslot_rl.training.demonstrated import ParsedVideos
    from playslot_rl.training.record import StageRecord, Training


def main(config: ExperimentConfig) -> None:
    """Train the oracle into `OUT/slot_oracle`; killed, the same command carries on; finished, it says so.

    Raises:
        CheckpointError: no finished slots in `run`, or `out` was begun otherwise.
        DataError: fewer than `demos` demonstrations, or none with actions.
        OutputError, TrainingError: see `playslot_rl.errors`.
    """
    from playslot_rl.methods.slot_oracle.method import STAGE
    from playslot_rl.training.record import StageRecord, run_stage
    from playslot_rl.training.runs import slots_checkpoint, stage_model, use_world_model

    run = open_run(config)
    parent = parent_run(config, run)
    slots = slots_checkpoint(parent)
    require_parent(config, run, slots, "image_size")
    model = replace(config.model, savi=stage_model(slots)[0].savi)
    record = StageRecord(
        STAGE,
        run,
        config,
        parents={"slots": slots},
        groups={"model": model},
        ready=partial(use_world_model, run, parent),
    )
    run_stage(record, lambda: _training(config, record, parent))


def _training(config: ExperimentConfig, record: StageRecord, parent: str) -> Training:
    import torch

    from playslot_rl.data.demonstrations import moving_slots, real_actions, require_finite, transitions
    from playslot_rl.modules.policy import LatentPolicy
    from playslot_rl.seeds.draws import global_seed
    from playslot_rl.training.demonstrated import cloned, demonstration_views
    from playslot_rl.training.fit import Part
    from playslot_rl.training.record import Training
    from playslot_rl.training.runs import load_savi
    from playslot_rl.training.stage_behaviour import oracle_stage

    device, split, width = open_device(config), record.demos, config.env.action_dim
    split.trained.require_actions(width)  # before anything is computed
    require_finite(split)
    savi = load_savi(parent, device)
    with global_seed(config.seed, 0, record.name):
        oracle = LatentPolicy(config.model.policy, savi.config.slot_dim, width, acts=True).to(device)

    behaviour = config.behaviour

    def examples(views: list[ParsedVideos]) -> tuple[Tensor, Tensor]:
        trim, margin = behaviour.trim, behaviour.trim_margin
        rows = [moving_slots(transitions(frames), cached, trim, margin).rows for frames, cached in views]
        slots = [torch.from_numpy(cached[at]) for (_, cached), at in zip(views, rows, strict=True)]
        actions = [real_actions(frames, at, width) for (frames, _), at in zip(views, rows, strict=True)]
        return torch.cat(slots).to(device), torch.cat(actions).to(device)

    views, others = demonstration_views(config, split, savi, record.prints["slots"])
    slots, actions = examples(views)
    stage = oracle_stage(oracle, slots, actions, behaviour, examples(others) if others else None)
    said, extra = cloned(record.name, split, len(slots), views=len(views))
    return Training(
        [Part(record.name, stage, config.behaviour, group="behaviour")],
        device,
        lambda _: f"{said}, {record.folder}",
        extra=extra,
    )
