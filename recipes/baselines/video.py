"""`playslot train-baseline method=svg|caddy|slotformer|ocvp_seq data.root=VIDEOS out=DIR`: models that predict frames.

SlotFormer and OCVP-Seq are trained on the slots of `run`'s SAVi. Sizes and schedule are `baselines.METHOD`; no action
is read.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

from playslot_rl.config import DynamicsStageConfig, ExperimentConfig, ModelConfig, VideoStageConfig
from playslot_rl.config.methods import METHODS
from playslot_rl.recipes.run import open_device, open_run, parent_run, require_parent

if TYPE_CHECKING:
    from playslot_rl.storage.checkpoints import StageCheckpoint
    from playslot_rl.training.patience import Patience
    from playslot_rl.training.record import StageRecord, Training


def main(config: ExperimentConfig) -> None:
    """Train `config.method`, see `train`."""
    train(config)


def train(config: ExperimentConfig) -> StageCheckpoint:
    """Train `config.method` into `OUT/METHOD`; killed, the same command carries on; finished, it says so.

    Raises:
        CheckpointError: no finished slots in `run`, where it builds on them, or `out` was begun otherwise.
        DataError: no videos, or none as long as a clip.
        OutputError, TrainingError: see `playslot_rl.errors`.
    """
    from playslot_rl.training.record import run_stage

    record = _record_on_slots(config) if METHODS[config.method].slots else _record(config, config.model, {})
    prepare = _on_slots if METHODS[config.method].slots else _on_pixels
    return run_stage(record, lambda: prepare(config, record))


def _record(config: ExperimentConfig, model: ModelConfig, parents: Mapping[str, StageCheckpoint]) -> StageRecord:
    from playslot_rl.methods.caddy import method as caddy
    from playslot_rl.methods.ocvp_seq import method as ocvp_seq
    from playslot_rl.methods.slotformer import method as slotformer
    from playslot_rl.methods.svg import method as svg
    from playslot_rl.training.record import StageRecord
    from playslot_rl.training.runs import use_world_model

    run, name = open_run(config), config.method
    specs = {"caddy": caddy.MODEL, "svg": svg.STAGE, "slotformer": slotformer.STAGE, "ocvp_seq": ocvp_seq.STAGE}
    return StageRecord(
        specs[name],
        run,
        config,
        parents=parents,
        groups={"model": model},
        ready=partial(use_world_model, run, parent_run(config, run)) if parents else lambda: None,
    )


def _record_on_slots(config: ExperimentConfig) -> StageRecord:
    from playslot_rl.methods.video.load import uncontrolled
    from playslot_rl.training.runs import slots_checkpoint, stage_model

    run = open_run(config)
    slots = slots_checkpoint(parent_run(config, run))
    require_parent(config, run, slots, "image_size")
    sizes = uncontrolled(config.model, config.baselines, config.method)
    return _record(config, replace(sizes, savi=stage_model(slots)[0].savi), {"slots": slots})


def _on_pixels(config: ExperimentConfig, record: StageRecord) -> Training:
    from playslot_rl.methods.caddy.model import CADDY
    from playslot_rl.methods.caddy.stage import CADDYStage
    from playslot_rl.methods.svg.stage import SVGStage
    from playslot_rl.methods.video.load import build_pixel_model
    from playslot_rl.seeds.draws import global_seed

    own: VideoStageConfig = getattr(config.baselines, config.method)
    device = open_device(config)
    with global_seed(config.seed, 0, config.method):
        model = build_pixel_model(config.method, config.baselines, config.env.image_size).to(device)
    clips = record.clips(own.seed_frames + own.predicted_frames)
    sizes = config.baselines
    stage = CADDYStage(model, clips, sizes.caddy) if isinstance(model, CADDY) else SVGStage(model, clips, sizes.svg)
    known = {"perceptual": stage.perceptual_on} if isinstance(stage, CADDYStage) else {}
    return _training(config, record, stage, device, extra=known)


def _on_slots(config: ExperimentConfig, record: StageRecord) -> Training:
    from playslot_rl.data.cache import Cache
    from playslot_rl.data.slot_cache import slot_cache
    from playslot_rl.methods.video.load import uncontrolled
    from playslot_rl.seeds.draws import global_seed
    from playslot_rl.storage.checkpoints import load_weights
    from playslot_rl.training.patience import patience_of
    from playslot_rl.training.runs import stage_model
    from playslot_rl.training.stage_dynamics import DynamicsStage
    from playslot_rl.world_model import WorldModel

    own: DynamicsStageConfig = getattr(config.baselines, config.method)
    device, slots = open_device(config), record.parents["slots"]
    sizes = replace(uncontrolled(config.model, config.baselines, config.method), savi=stage_model(slots)[0].savi)
    with global_seed(config.seed, 0, config.method):
        world = WorldModel(sizes, config.env)
    load_weights(slots, {"savi": world.savi})
    world.to(device)
    source = record.data
    cached = slot_cache(source, world.savi, slots.fingerprint, Cache.of(config.data), device, config.logging.progress)
    stage = DynamicsStage(world, record.clips(own.seed_frames + own.predicted_frames), cached, own)
    return _training(config, record, stage, device, patience_of(own.patience, "mse_slot"))


def _training(
    config: ExperimentConfig,
    record: StageRecord,
    stage: Any,
    device: Any,
    patience: Patience | None = None,
    extra: Mapping[str, Any] | None = None,
) -> Training:
    from playslot_rl.training.fit import Part
    from playslot_rl.training.record import Training

    own, name = getattr(config.baselines, config.method), config.method
    return Training(
        [Part(f"baselines.{name}", stage, own, patience=patience)],
        device,
        lambda metrics: f"{name}: {metrics.get('psnr', float('nan')):.2f} dB on held-out clips, {record.folder}",
        extra={"episodes": record.data.episodes} | dict(extra or {}),
    )
