"""`playslot train-dynamics run=RUN data.root=DIR`: stage 2, InvDyn and cOCVP on the slots of the run's SAVi."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

from playslot_rl.config import ExperimentConfig, ModelConfig, to_dict
from playslot_rl.recipes.run import open_device, open_run, open_videos, parent_run, store_config

if TYPE_CHECKING:
    from playslot_rl.training.record import StageRecord, Training


def main(config: ExperimentConfig) -> None:
    """Train the dynamics into `RUN/dynamics`; killed, the same command carries on; finished, it says so.

    Raises:
        CheckpointError: no finished slots stage, or the run was begun otherwise.
        DataError, OutputError, TrainingError: see `playslot_rl.errors`.
    """
    from playslot_rl.storage.checkpoints import checkpoint_folder, read_stage, require_config
    from playslot_rl.training.record import StageRecord, run_stage
    from playslot_rl.training.runs import adopt_stage, require_adoptable, run_folder, stage_model

    run = open_run(config)
    slots = read_stage(checkpoint_folder(run_folder(parent_run(config, run)), "slots"), "slots")
    require_config(slots, {"env": {"image_size": config.env.image_size}})
    require_adoptable(slots, run)
    model = replace(config.model, savi=stage_model(slots)[0].savi)

    def ready() -> None:
        adopt_stage(slots, run)
        store_config(config, run)

    record = StageRecord(
        "dynamics",
        run,
        config,
        stored={"env": to_dict(config.env), "model": to_dict(model), "dynamics": to_dict(config.dynamics)},
        counts=("model.inverse_dynamics", "model.predictor"),
        identity={"data.validation": config.data.validation},
        parents={"slots": slots},
        open_data=partial(open_videos, config, config.data.root, "train-dynamics"),
        named=bool(config.data.root),
        ready=ready,
    )
    run_stage(record, partial(_training, config, record, model))


def _training(config: ExperimentConfig, record: StageRecord, model: ModelConfig) -> Training:
    from playslot_rl.data.slot_cache import slot_cache
    from playslot_rl.seeding import global_seed
    from playslot_rl.storage.checkpoints import load_weights
    from playslot_rl.training.fit import Part
    from playslot_rl.training.record import Training
    from playslot_rl.training.stage_dynamics import DynamicsStage
    from playslot_rl.world_model import WorldModel

    device, source, slots = open_device(config), record.data, record.parents["slots"]
    with global_seed(config.seed, 0, "dynamics"):
        world = WorldModel(model, config.env)
    load_weights(slots, {"savi": world.savi})
    world.to(device)
    cached = slot_cache(source, world.savi, slots.fingerprint, config.data.cache, device, config.logging.progress)
    stage = DynamicsStage(
        world, source, cached, config.dynamics, validation=config.data.validation, seed=config.seed, device=device
    )
    return Training(
        [Part("dynamics", stage, config.dynamics)],
        device,
        lambda metrics: (
            f"dynamics: {metrics.get('psnr', float('nan')):.2f} dB on held-out rollouts, "
            f"code perplexity {metrics.get('perplexity', float('nan')):.1f}, {record.folder}"
        ),
        extra={"episodes": source.episodes},
    )
