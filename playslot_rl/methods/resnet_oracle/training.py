"""Training of the ResNet oracle: the head's sizes are `model.policy`, the schedule is `baselines.resnet_oracle`."""

from __future__ import annotations

from playslot_rl import keys
from playslot_rl.data.demonstrations import require_finite
from playslot_rl.methods.cloning import action_stage
from playslot_rl.methods.resnet_oracle.method import NAME, ResNetOracleConfig
from playslot_rl.methods.resnet_oracle.network import ResNetPolicy, load_trunk
from playslot_rl.seeds.draws import global_seed
from playslot_rl.training.demonstrated import cloning_alone
from playslot_rl.training.fit import Part
from playslot_rl.training.patience import Patience
from playslot_rl.training.record import StageRecord
from playslot_rl.training.run_stage import Training
from playslot_rl.training.stage_regression import HELD_OUT


def with_history(record: StageRecord) -> Training:
    """From the last frames."""
    own: ResNetOracleConfig = record.config.baselines.resnet_oracle
    return training(record, own.history)


def training(record: StageRecord, frames: int = 1) -> Training:
    config, device, split = record.config, record.device, record.demos
    own: ResNetOracleConfig = config.baselines.resnet_oracle
    require_finite(split)
    with global_seed(config.seed, 0, record.name):
        env = config.env
        policy = ResNetPolicy(config.model.policy, env.image_size, env.action_dim, frames, len(env.tasks))
    pretraining = load_trunk(policy.trunk, own.weights, f"baselines.{NAME}.weights")
    policy.to(device)
    stage = action_stage("policy", policy, keys.PIXELS, lambda x: x, config, split, device, own.shift, own, 512, frames)
    patience = Patience(own.patience, f"unexplained{HELD_OUT}") if own.patience and split.held_out is not None else None
    part = Part(f"baselines.{record.name}", stage, own, group=f"baselines.{NAME}", patience=patience)
    said = f", ResNet-18 from {pretraining}"
    return cloning_alone(record, part, len(stage.targets), said, {"pretraining": pretraining})
