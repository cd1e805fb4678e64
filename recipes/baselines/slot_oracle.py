"""`playslot train-baseline method=slot_oracle run=WORLD data.demos=DEMOS out=DIR`: clone real actions from slots.

Sizes are `model.policy`, the schedule is `behaviour`, as for PlaySlot's policy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import TYPE_CHECKING

from playslot_rl.config import ExperimentConfig, ModelConfig, to_dict
from playslot_rl.recipes.run import (
    demo_root,
    demonstration_views,
    held_out_text,
    open_demonstrations,
    open_device,
    open_run,
    parent_run,
    store_config,
)

if TYPE_CHECKING:
    from torch import Tensor

    from playslot_rl.data.demonstrations import DemonstrationSplit
    from playslot_rl.recipes.run import ParsedVideos
    from playslot_rl.training.record import StageRecord, Training


def main(config: ExperimentConfig) -> None:
    """Train the oracle into `OUT/slot_oracle`; killed, the same command carries on; finished, it says so.

    Raises:
        CheckpointError: no finished slots in `run`, or `out` was begun otherwise.
        DataError: fewer than `demos` demonstrations, or none with actions.
        OutputError, TrainingError: see `playslot_rl.errors`.
    """
    from playslot_rl.baselines.oracles.slot import NAME
    from playslot_rl.storage.checkpoints import checkpoint_folder, read_stage, require_config
    from playslot_rl.training.record import StageRecord, run_stage
    from playslot_rl.training.runs import require_adoptable, stage_model, use_world_model, world_model_folder

    run = open_run(config)
    parent = parent_run(config, run)
    slots = read_stage(checkpoint_folder(world_model_folder(parent), "slots"), "slots")
    require_adoptable(slots, run)
    require_config(slots, {"env": {"image_size": config.env.image_size}})
    model = replace(config.model, savi=stage_model(slots)[0].savi)
    demos = cache(partial(open_demonstrations, config, "train-baseline"))

    def ready() -> None:
        use_world_model(run, parent)
        store_config(config, run)

    record = StageRecord(
        NAME,
        run,
        config,
        stored={"env": to_dict(config.env), "model": to_dict(model), NAME: to_dict(config.behaviour)},
        counts=("model.policy",),
        parents={"slots": slots},
        open_data=lambda: demos().trained,
        named=bool(demo_root(config)),
        role="demos",
        ready=ready,
    )
    run_stage(record, lambda: _training(config, record, parent, model, demos))


def _training(
    config: ExperimentConfig,
    record: StageRecord,
    parent: str,
    model: ModelConfig,
    opened: Callable[[], DemonstrationSplit],
) -> Training:
    import torch

    from playslot_rl.baselines.oracles.slot import NAME
    from playslot_rl.data.demonstrations import real_actions, transitions
    from playslot_rl.modules.policy import LatentPolicy
    from playslot_rl.seeding import global_seed
    from playslot_rl.training.fit import Part
    from playslot_rl.training.record import Training
    from playslot_rl.training.runs import load_savi
    from playslot_rl.training.stage_behaviour import oracle_stage

    device, split, width = open_device(config), opened(), config.env.action_dim
    split.trained.require_actions(width)  # before anything is computed
    savi = load_savi(parent, device)
    with global_seed(config.seed, 0, NAME):
        oracle = LatentPolicy(model.policy, model.savi.slot_dim, width).to(device)

    def examples(views: list[ParsedVideos]) -> tuple[Tensor, Tensor]:
        rows = [transitions(frames).rows for frames, _ in views]
        slots = [torch.from_numpy(cached[at]) for (_, cached), at in zip(views, rows, strict=True)]
        actions = [real_actions(frames, at, width) for (frames, _), at in zip(views, rows, strict=True)]
        return torch.cat(slots).to(device), torch.cat(actions).to(device)

    views, others = demonstration_views(config, split, savi, record.prints["slots"])
    stage = oracle_stage(oracle, *examples(views), config.behaviour, examples(others) if others else None)
    demos = int((split.trained.lengths >= 2).sum())
    said = f"{NAME}: {demos} demos, all labelled, {held_out_text(split)}"
    return Training(
        [Part(NAME, stage, config.behaviour, lr_key="behaviour.optim.lr")],
        device,
        lambda _: f"{said}, {record.folder}",
        extra={"demos": demos, "labelled_demos": demos},
    )
