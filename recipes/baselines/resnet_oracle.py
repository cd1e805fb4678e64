"""`playslot train-baseline method=resnet_oracle data.demos=DEMOS demos=N out=DIR`: clone real actions from frames.

The head's sizes are `model.policy`, the schedule is `baselines.resnet_oracle`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from playslot_rl.config import ExperimentConfig
from playslot_rl.recipes.run import open_device, open_run

if TYPE_CHECKING:
    from playslot_rl.data.demonstrations import Transitions
    from playslot_rl.data.source import EpisodeFrames
    from playslot_rl.training.record import StageRecord, Training


def main(config: ExperimentConfig) -> None:
    """Train the oracle into `OUT/resnet_oracle`; killed, the same command carries on; finished, it says so.

    Raises:
        CheckpointError: no such weights to start from, or `out` was begun otherwise.
        DataError: fewer than `demos` demonstrations, or none with actions.
        OutputError, TrainingError: see `playslot_rl.errors`.
    """
    from playslot_rl.methods.resnet_oracle.method import STAGE
    from playslot_rl.training.record import StageRecord, run_stage

    record = StageRecord(STAGE, open_run(config), config)
    run_stage(record, lambda: _training(config, record))


def _training(config: ExperimentConfig, record: StageRecord) -> Training:
    from playslot_rl import keys
    from playslot_rl.data.demonstrations import moving_frames, require_finite
    from playslot_rl.losses.behaviour import BehaviourLoss
    from playslot_rl.methods.oracles.resnet import NAME, ResNetPolicy, load_pretrained
    from playslot_rl.seeds.draws import global_seed
    from playslot_rl.training.demonstrated import cloned
    from playslot_rl.training.fit import Part
    from playslot_rl.training.patience import Patience
    from playslot_rl.training.record import Training
    from playslot_rl.training.stage_regression import HELD_OUT, RegressionStage, demonstrated_frames

    own, device, split, width = config.baselines.resnet_oracle, open_device(config), record.demos, config.env.action_dim
    behaviour = config.behaviour

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
