"""`playslot train-baseline method=lapo data.root=VIDEOS data.demos=DEMOS demos=N out=DIR`: LAPO.

Inverse and forward model on the videos, a latent policy on the demonstrations' videos, an action decoder on the real
actions of `behaviour.labelled_demos` of them. `baselines.lapo.world=RUN` takes the models of another run.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from playslot_rl.config import ExperimentConfig
from playslot_rl.recipes.baselines.cloning import cloning, model_of
from playslot_rl.recipes.run import open_device, open_run

if TYPE_CHECKING:
    from playslot_rl.storage.checkpoints import StageCheckpoint
    from playslot_rl.training.record import StageRecord, Training


def main(config: ExperimentConfig) -> None:
    """Train LAPO into `OUT/lapo_model` and `OUT/lapo`; killed, the same command carries on; finished, it says so.

    Raises:
        CheckpointError: `out` was begun otherwise, or `baselines.lapo.world` is no finished model of these sizes.
        DataError: no videos, too few demonstrations, or none with actions.
        OutputError, TrainingError: see `playslot_rl.errors`.
    """
    from playslot_rl.methods.lapo.load import MODEL, NAME, sizes_of
    from playslot_rl.methods.lapo.method import POLICY
    from playslot_rl.storage.checkpoints import StageCheckpoint
    from playslot_rl.training.record import StageRecord, run_stage
    from playslot_rl.training.runs import adopt_stage

    run, own, parents = open_run(config), config.baselines.lapo, dict[str, StageCheckpoint]()
    record = StageRecord(POLICY, run, config, parents, ready=lambda: adopt_stage(parents[MODEL], run))
    record.data.require_actions(config.env.action_dim)
    labelled, sizes = config.behaviour.labelled_demos, {NAME: sizes_of(own)}
    parents[MODEL] = model_of(config, run, MODEL, own.world, train_model, record.demos, labelled, sizes)
    run_stage(record, lambda: _training(config, record))


def train_model(config: ExperimentConfig, run: Path) -> StageCheckpoint:
    """Train inverse and forward model on `data.root` into `RUN/lapo_model`, or find them there.

    Raises:
        CheckpointError, DataError, OutputError, TrainingError: see `playslot_rl.errors`.
    """
    from playslot_rl.methods.lapo.load import MODEL
    from playslot_rl.methods.lapo.method import MODEL as STAGE
    from playslot_rl.methods.lapo.model import ForwardModel, InverseModel
    from playslot_rl.methods.lapo.stage import LAPOModelStage
    from playslot_rl.seeds.draws import global_seed
    from playslot_rl.training.fit import Part
    from playslot_rl.training.record import StageRecord, Training, run_stage

    own = config.baselines.lapo
    record = StageRecord(STAGE, run, config)

    def prepare() -> Training:
        device = open_device(config)
        with global_seed(config.seed, 0, MODEL):
            inverse, forward = InverseModel(own, config.env.image_size).to(device), ForwardModel(own).to(device)
        stage = LAPOModelStage(inverse, forward, record.clips(2, shown=256), own.model)
        return Training(
            [Part("baselines.lapo.model", stage, own.model)],
            device,
            lambda metrics: (
                f"{MODEL}: {100 * metrics.get('unexplained', float('nan')):.0f} % of the change left on held-out "
                f"pairs, {record.folder}"
            ),
            extra={"episodes": record.data.episodes},
        )

    return run_stage(record, prepare)


def _training(config: ExperimentConfig, record: StageRecord) -> Training:
    from playslot_rl.methods.lapo.behaviour import LAPOBehaviour
    from playslot_rl.methods.lapo.load import MODEL

    own, device = config.baselines.lapo, open_device(config)
    behaviour = LAPOBehaviour(config, record.parents[MODEL], record.demos, device)
    return cloning(config, record, behaviour, own.policy, own.decoder_steps, own.decoder_lr)
