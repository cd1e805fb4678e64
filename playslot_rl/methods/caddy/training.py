"""Trainings of CADDY's video model, and of the policy and the oracle on its states."""

from __future__ import annotations

from playslot_rl.methods.caddy.behaviour import CADDYBehaviour, oracle_stage
from playslot_rl.methods.caddy.config import CADDYConfig, CADDYOracleConfig, CADDYPolicyConfig
from playslot_rl.methods.caddy.model import CADDY
from playslot_rl.methods.caddy.stage import CADDYStage
from playslot_rl.methods.cloning import cloning
from playslot_rl.methods.video.training import on_clips, pixel_model
from playslot_rl.training.demonstrated import cloned
from playslot_rl.training.fit import Part
from playslot_rl.training.record import StageRecord, Training


def model(record: StageRecord) -> Training:
    """A new video model."""
    own: CADDYConfig = record.config.baselines.caddy
    stage = CADDYStage(pixel_model(CADDY, own, record), record.clips(own.frames), own)
    return on_clips(record, stage, own, extra={"perceptual": stage.perceptual_on})


def policy(record: StageRecord) -> Training:
    """New policy and decoder on the demonstrations."""
    own: CADDYPolicyConfig = record.config.baselines.caddy_policy
    behaviour = CADDYBehaviour(record.config, record.parents["caddy"], record.demos, record.device)
    return cloning(record, behaviour, own.policy, own.decoder_steps, own.decoder_lr)


def oracle(record: StageRecord) -> Training:
    """A new head on the real actions of the demonstrations."""
    own: CADDYOracleConfig = record.config.baselines.caddy_oracle
    stage = oracle_stage(record.config, record.parents["caddy"], record.demos, record.device)
    said, extra = cloned(record.name, record.demos, len(stage.targets))
    part = Part(f"{record.name}.policy", stage, own.policy, group=f"baselines.{record.name}.policy")
    return Training([part], record.device, lambda _: f"{said}, {record.folder}", extra=extra)
