"""Trained CADDY runs: the model, and the two methods that act on its states as actors.

RUN/caddy/checkpoint           the model, which both build on
RUN/caddy_policy/checkpoint    modules `policy`, `action_decoder`
RUN/caddy_oracle/checkpoint    module `oracle`
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import torch

from playslot_rl import keys
from playslot_rl.acting.actor import Actor, ReactiveActor, latent_actor
from playslot_rl.config import CADDYConfig, EnvConfig
from playslot_rl.methods.caddy.heads import MovesHead, OnFrames, StateHead
from playslot_rl.methods.caddy.model import CADDY
from playslot_rl.modules.action_decoder import ActionDecoder
from playslot_rl.storage.checkpoints import (
    StageCheckpoint,
    checkpoint_folder,
    load_weights,
    read_stage,
    require_parents,
)
from playslot_rl.training.runs import freeze_on, stage_config, stage_model
from playslot_rl.world_model import oracle_module

MODEL: Final = "caddy"
POLICY: Final = "caddy_policy"
ORACLE: Final = "caddy_oracle"


def load_model(done: StageCheckpoint, device: torch.device | str = "cpu") -> CADDY:
    """The CADDY of a finished stage, frozen.

    Raises:
        CheckpointError: it is damaged.
    """
    with torch.random.fork_rng(devices=[]):
        model = CADDY(stage_config(done, CADDYConfig, MODEL), stage_config(done, EnvConfig, "env").image_size)
    load_weights(done, {MODEL: model})
    freeze_on(model, device)
    return model


def load_policy(run: Path, device: torch.device | str = "cpu") -> Actor:
    """CADDY's actor of a finished run.

    Raises:
        CheckpointError: it is missing or damaged, or was trained on another model.
    """
    done, caddy = _finished(run, POLICY, device)
    sizes, env = stage_model(done)
    own = caddy.config
    with torch.random.fork_rng(devices=[]):
        head = MovesHead(own.encoder[-1], own.actions, own.latent_dim)
        decoder = ActionDecoder(sizes.action_decoder, own.actions + own.latent_dim, env.action_dim)
    load_weights(done, {"policy": head, "action_decoder": decoder})
    freeze_on(head, device)
    freeze_on(decoder, device)
    return latent_actor(OnFrames(caddy.encoder, head), decoder)


def load_oracle(run: Path, device: torch.device | str = "cpu") -> Actor:
    """The CADDY Oracle's actor of a finished run; actions clamped to [-1, 1].

    Raises:
        CheckpointError: it is missing or damaged, or was trained on another model.
    """
    done, caddy = _finished(run, ORACLE, device)
    with torch.random.fork_rng(devices=[]):
        head = StateHead(caddy.config.encoder[-1], stage_config(done, EnvConfig, "env").action_dim, acts=True)
    load_weights(done, {"oracle": head})
    freeze_on(head, device)
    return ReactiveActor(oracle_module(OnFrames(caddy.encoder, head), keys.PIXELS))


def _finished(run: Path, stage: str, device: torch.device | str) -> tuple[StageCheckpoint, CADDY]:
    """A finished stage of a run, and the model that it was trained on."""
    done = read_stage(checkpoint_folder(run, stage), stage)
    model = read_stage(checkpoint_folder(run, MODEL), MODEL)
    require_parents(done, {MODEL: model})
    return done, load_model(model, device)
