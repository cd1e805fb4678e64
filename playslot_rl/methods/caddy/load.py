"""Trained CADDY runs: the model, and the two methods that act on its states as actors.

RUN/caddy/checkpoint           the model, which both build on
RUN/caddy_policy/checkpoint    modules `policy`, `action_decoder`
RUN/caddy_oracle/checkpoint    module `oracle`
"""

from __future__ import annotations

from typing import Final

import torch

from playslot_rl import keys
from playslot_rl.acting.actor import Actor, ReactiveActor, latent_actor
from playslot_rl.config import EnvConfig
from playslot_rl.methods.caddy.config import CADDYConfig
from playslot_rl.methods.caddy.heads import MovesHead, OnFrames, StateHead
from playslot_rl.methods.caddy.model import CADDY
from playslot_rl.methods.decoded_policy import DecodedPolicy
from playslot_rl.runs import Run
from playslot_rl.storage.checkpoints import StageCheckpoint
from playslot_rl.world_model import oracle_module

MODEL: Final = "caddy"
POLICY: Final = "caddy_policy"
ORACLE: Final = "caddy_oracle"


def load_model(done: StageCheckpoint, device: torch.device | str = "cpu") -> CADDY:
    """The CADDY of a finished stage, frozen; a CheckpointError where it is damaged."""
    own, size = done.group(CADDYConfig, MODEL), done.group(EnvConfig, "env").image_size
    return done.restore(lambda: CADDY(own, size), MODEL, device)


def load_video(run: Run, device: torch.device | str = "cpu") -> CADDY:
    return load_model(run.stage(MODEL), device)


def load_policy(run: Run, device: torch.device | str = "cpu") -> Actor:
    """CADDY's actor; a CheckpointError where a stage is missing, damaged, or of another model."""
    done, caddy = run.stage(POLICY, MODEL), load_video(run, device)
    own = caddy.config
    width, k, z = own.encoder[-1], own.actions, own.latent_dim
    parts = DecodedPolicy.load(done, lambda: MovesHead(width, k, z), k + z, device)
    return latent_actor(OnFrames(caddy.encoder, parts.policy), parts.action_decoder)


def load_oracle(run: Run, device: torch.device | str = "cpu") -> Actor:
    """The CADDY Oracle's actor, actions clamped to [-1, 1]; raises as `load_policy`."""
    done, caddy = run.stage(ORACLE, MODEL), load_video(run, device)
    width = done.group(EnvConfig, "env").action_dim
    head = done.restore(lambda: StateHead(caddy.config.encoder[-1], width, acts=True), "oracle", device)
    return ReactiveActor(oracle_module(OnFrames(caddy.encoder, head), keys.PIXELS))
