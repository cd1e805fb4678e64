"""Training of the ResNet oracle: the head's sizes are `model.policy`, the schedule is `baselines.resnet_oracle`."""

from __future__ import annotations

from playslot_rl import keys
from playslot_rl.data.demonstrations import Transitions, moving_frames, require_finite
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.losses.behaviour import BehaviourLoss
from playslot_rl.methods.resnet_oracle.method import NAME, ResNetOracleConfig
from playslot_rl.methods.resnet_oracle.network import ResNetPolicy, load_pretrained
from playslot_rl.seeds.draws import global_seed
from playslot_rl.training.demonstrated import cloned
from playslot_rl.training.fit import Part
from playslot_rl.training.patience import Patience
from playslot_rl.training.record import StageRecord, Training
from playslot_rl.training.stage_regression import HELD_OUT, RegressionStage, demonstrated_frames


def training(record: StageRecord) -> Training:
    config, device, split = record.config, record.device, record.demos
    own: ResNetOracleConfig = config.baselines.resnet_oracle
    behaviour, width = config.behaviour, config.env.action_dim

    def moving(source: EpisodeFrames) -> Transitions:
        return moving_frames(source, behaviour.trim_pixels, behaviour.trim_margin)

    require_finite(split)
    moves = moving(split.trained)
    inputs, actions = demonstrated_frames(split.trained, moves, width, device, own.shift)
    held_out = split.held_out
    with global_seed(config.seed, 0, NAME):
        policy = ResNetPolicy(config.model.policy, config.env.image_size, width)
    pretraining = load_pretrained(policy, own.weights)
    policy.to(device)
    criterion = BehaviourLoss(policy, config.behaviour.loss)
    criterion.set_keys(observation=keys.PIXELS, action=keys.ACTION)
    stage = RegressionStage(
        "policy",
        criterion,
        inputs,
        actions,
        own.batch_size,
        held_out=None if held_out is None else demonstrated_frames(held_out, moving(held_out), width, device),
        validated=512,
        precision=own.precision,
    )
    patience = Patience(own.patience, f"unexplained{HELD_OUT}") if own.patience and held_out is not None else None
    said, extra = cloned(NAME, split, len(moves.rows))
    return Training(
        [Part(f"baselines.{NAME}", stage, own, patience=patience)],
        device,
        lambda _: f"{said}, ResNet-18 from {pretraining}, {record.folder}",
        extra={**extra, "pretraining": pretraining},
        identity={"pretraining": pretraining},
    )
