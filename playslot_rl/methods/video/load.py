"""Video predictors made anew and loaded from runs, by method."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from playslot_rl.config import (
    EnvConfig,
    ModelConfig,
    SVGConfig,
)
from playslot_rl.config.baselines import BaselinesConfig
from playslot_rl.errors import ConfigError
from playslot_rl.methods.caddy.load import load_model
from playslot_rl.methods.caddy.model import CADDY
from playslot_rl.methods.caddy.perceptual import load_perceptual
from playslot_rl.methods.svg.model import SVG
from playslot_rl.methods.video.predictor import VideoPredictor
from playslot_rl.methods.video.slots import SlotVideo
from playslot_rl.storage.checkpoints import (
    checkpoint_folder,
    load_weights,
    read_stage,
    require_parents,
)
from playslot_rl.training.runs import (
    freeze_on,
    load_world_model,
    run_folder,
    slots_checkpoint,
    stage_config,
    stage_model,
)
from playslot_rl.world_model import WorldModel


def build_pixel_model(method: str, config: BaselinesConfig, image_size: int) -> SVG | CADDY:
    """An untrained SVG-LP or CADDY.

    Raises:
        ConfigError: frames of a size that its convolutions do not fit.
    """
    try:
        return SVG(config.svg, image_size) if method == "svg" else CADDY(config.caddy, image_size)
    except ValueError as error:
        raise ConfigError(f"env.{error}: change it, or leave out method {method}") from None


def check_pixel_model(method: str, config: BaselinesConfig, image_size: int) -> None:
    """Refuse frames or weights that SVG-LP or CADDY cannot take, before anything is computed.

    Raises:
        ConfigError: as `build_pixel_model`.
        CheckpointError: as `load_perceptual`.
    """
    with torch.device("meta"):
        build_pixel_model(method, config, image_size)
    if method == "caddy":
        load_perceptual(config.caddy.perceptual)


def uncontrolled(model: ModelConfig, config: BaselinesConfig, method: str) -> ModelConfig:
    """The sizes of a world model in which nothing is inferred, and SlotFormer or OCVP-Seq predicts."""
    own = config.slotformer if method == "slotformer" else config.ocvp_seq
    inverse = replace(model.inverse_dynamics, mode="none", variant="single")
    return replace(model, inverse_dynamics=inverse, predictor=own.predictor)


def load_video(method: str, run: Path | str, device: torch.device | str = "cpu") -> VideoPredictor:
    """The predictor of a finished run, in evaluation mode.

    Args:
        method: `playslot` loads the run's world model, others the checkpoint of that name.
        run: its folder.
        device: where it computes.

    Raises:
        CheckpointError: it is missing or damaged, or was trained on other slots.
    """
    if method == "playslot":
        return SlotVideo(load_world_model(run, device))
    done = read_stage(checkpoint_folder(run_folder(run), method), method)
    if method == "caddy":
        return load_model(done, device)
    if method == "svg":
        with torch.random.fork_rng(devices=[]):
            model = SVG(stage_config(done, SVGConfig, method), stage_config(done, EnvConfig, "env").image_size)
        load_weights(done, {method: model})
        freeze_on(model, device)
        return model
    slots = slots_checkpoint(run)
    require_parents(done, {"slots": slots})
    sizes, env = stage_model(done)
    with torch.random.fork_rng(devices=[]):
        world = WorldModel(replace(sizes, savi=stage_model(slots)[0].savi), env)
    load_weights(slots, {"savi": world.savi})
    load_weights(done, {"inverse_dynamics": world.inverse_dynamics, "predictor": world.predictor})
    freeze_on(world, device)
    return SlotVideo(world)
