"""`playslot train-baseline method=caddy_policy|caddy_oracle data.root=VIDEOS data.demos=DEMOS out=DIR`: CADDY acts.

CADDY learns from the videos (`OUT/caddy`, as `method=caddy` trains it) and is frozen. `caddy_policy` clones the actions
and variabilities that it infers from the demonstrations' videos, and decodes them by the real actions of
`behaviour.labelled_demos`; `caddy_oracle` clones the real actions of all. `baselines.METHOD.world=RUN` takes the CADDY
of another run.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from playslot_rl.config import ExperimentConfig
from playslot_rl.recipes.baselines.cloning import cloning, model_of
from playslot_rl.recipes.run import open_device, open_run

if TYPE_CHECKING:
    from playslot_rl.storage.checkpoints import StageCheckpoint
    from playslot_rl.training.record import StageRecord, Training


def main(config: ExperimentConfig) -> None:
    """Train `config.method` into `OUT/METHOD`; killed, the same command carries on; finished, it says so.

    Raises:
        CheckpointError: `out` was begun otherwise, or `baselines.METHOD.world` has no finished CADDY of such frames.
        DataError: no videos, too few demonstrations, or none with actions.
        OutputError, TrainingError: see `playslot_rl.errors`.
    """
    from playslot_rl.methods.caddy import method
    from playslot_rl.methods.caddy.load import MODEL, POLICY
    from playslot_rl.storage.checkpoints import StageCheckpoint
    from playslot_rl.training.record import StageRecord, run_stage
    from playslot_rl.training.runs import adopt_stage

    run, parents = open_run(config), dict[str, StageCheckpoint]()
    acts = config.method == POLICY
    spec = method.POLICY if acts else method.ORACLE
    record = StageRecord(spec, run, config, parents, ready=lambda: adopt_stage(parents[MODEL], run))
    record.data.require_actions(config.env.action_dim)
    labelled = config.behaviour.labelled_demos if acts else None
    world = config.baselines.caddy_policy.world if acts else config.baselines.caddy_oracle.world
    parents[MODEL] = model_of(config, run, MODEL, world, train_model, record.demos, labelled)
    run_stage(record, lambda: (_policy if acts else _oracle)(config, record))


def train_model(config: ExperimentConfig, run: Path) -> StageCheckpoint:
    """Train CADDY on `data.root` into `RUN/caddy`, or find it there.

    Raises:
        CheckpointError, DataError, OutputError, TrainingError: see `playslot_rl.errors`.
    """
    from playslot_rl.methods.caddy.load import MODEL
    from playslot_rl.recipes.baselines import video

    return video.train(replace(config, method=MODEL, out=str(run), run=""))


def _policy(config: ExperimentConfig, record: StageRecord) -> Training:
    from playslot_rl.methods.caddy.behaviour import CADDYBehaviour
    from playslot_rl.methods.caddy.load import MODEL

    own, device = config.baselines.caddy_policy, open_device(config)
    behaviour = CADDYBehaviour(config, record.parents[MODEL], record.demos, device)
    return cloning(config, record, behaviour, own.policy, own.decoder_steps, own.decoder_lr)


def _oracle(config: ExperimentConfig, record: StageRecord) -> Training:
    from playslot_rl.methods.caddy.behaviour import oracle_stage
    from playslot_rl.methods.caddy.load import MODEL
    from playslot_rl.training.demonstrated import cloned
    from playslot_rl.training.fit import Part
    from playslot_rl.training.record import Training

    own, device, split = config.baselines.caddy_oracle, open_device(config), record.demos
    stage = oracle_stage(config, record.parents[MODEL], split, device)
    said, extra = cloned(record.name, split, len(stage.targets))
    return Training(
        [Part(f"{record.name}.policy", stage, own.policy, group=f"baselines.{record.name}.policy")],
        device,
        lambda _: f"{said}, {record.folder}",
        extra=extra,
    )
