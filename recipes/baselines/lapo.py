"""`playslot train-baseline method=lapo data.root=VIDEOS data.demos=DEMOS demos=N out=DIR`: LAPO.

Inverse and forward model on the videos, a latent policy on the demonstrations' videos, an action decoder on the real
actions of `behaviour.labelled_demos` of them. `baselines.lapo.world=RUN` takes the models of another run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

from playslot_rl.config import ExperimentConfig, to_dict
from playslot_rl.recipes.run import (
    demo_root,
    held_out_text,
    open_demonstrations,
    open_device,
    open_run,
    open_videos,
    store_config,
)

if TYPE_CHECKING:
    from playslot_rl.data.demonstrations import DemonstrationSplit
    from playslot_rl.storage.checkpoints import StageCheckpoint
    from playslot_rl.training.fit import Part
    from playslot_rl.training.record import StageRecord, Training


def main(config: ExperimentConfig) -> None:
    """Train LAPO into `OUT/lapo_model` and `OUT/lapo`; killed, the same command carries on; finished, it says so.

    Raises:
        CheckpointError: `out` was begun otherwise, or `baselines.lapo.world` is no finished model of these sizes.
        DataError: no videos, too few demonstrations, or none with actions.
        OutputError, TrainingError: see `playslot_rl.errors`.
    """
    from playslot_rl.baselines.lapo.load import MODEL, NAME, given_model, sizes_of
    from playslot_rl.data.demonstrations import require_labelled
    from playslot_rl.training.record import StageRecord, run_stage
    from playslot_rl.training.runs import adopt_stage

    run, own = open_run(config), config.baselines.lapo
    demos = cache(partial(open_demonstrations, config, "train-baseline"))
    demos().trained.require_actions(config.env.action_dim)
    require_labelled(config.behaviour.labelled_demos, demos().trained.episodes)  # before anything is computed
    model = given_model(own, config.env.image_size, run) if own.world else train_model(config, run)

    def ready() -> None:
        store_config(config, run)  # first: it is what marks the folder as a run, should a kill come in between
        if own.world:
            adopt_stage(model, run)

    stored = {
        "env": to_dict(config.env),
        "model": to_dict(config.model),
        "behaviour": to_dict(config.behaviour),
        NAME: to_dict(own),
    }
    its_own = (f"{NAME}.{key}" for key in stored[NAME] if key not in ("model", "world"))
    record = StageRecord(
        NAME,
        run,
        config,
        stored=stored,
        settings=("model.action_decoder", "behaviour.labelled_demos", "behaviour.decoder_inputs", *its_own),
        identity={
            "action_decoder": to_dict(config.model.action_decoder),
            NAME: sizes_of(own),
            "loss": own.loss,
            "shift": own.shift,
        },
        parents={MODEL: model},
        open_data=lambda: demos().trained,
        named=bool(demo_root(config)),
        role="demos",
        ready=ready,
    )
    run_stage(record, lambda: _training(config, record, demos))


def train_model(config: ExperimentConfig, run: Path) -> StageCheckpoint:
    """Train inverse and forward model on `data.root` into `RUN/lapo_model`, or find them there.

    Raises:
        CheckpointError, DataError, OutputError, TrainingError: see `playslot_rl.errors`.
    """
    from playslot_rl.baselines.lapo.load import MODEL, NAME, sizes_of
    from playslot_rl.training.record import StageRecord, run_stage

    own = config.baselines.lapo
    record = StageRecord(
        MODEL,
        run,
        config,
        stored={"env": to_dict(config.env), "model": to_dict(config.model), NAME: to_dict(own)},
        counts=tuple(f"{NAME}.{key}" for key in sizes_of(own)),
        settings=(f"{NAME}.model",),
        identity={"data.validation": config.data.validation},
        open_data=partial(open_videos, config, config.data.root, "train-baseline"),
        named=bool(config.data.root),
        ready=partial(store_config, config, run),
    )
    return run_stage(record, partial(_model_training, config, record))


def _model_training(config: ExperimentConfig, record: StageRecord) -> Training:
    """Inverse and forward model, untrained."""
    from playslot_rl.baselines.lapo.model import ForwardModel, InverseModel
    from playslot_rl.baselines.lapo.stage import LAPOModelStage
    from playslot_rl.seeding import global_seed
    from playslot_rl.training.fit import Part
    from playslot_rl.training.record import Training

    own, device, source = config.baselines.lapo, open_device(config), record.data
    with global_seed(config.seed, 0, record.name):
        inverse, forward = InverseModel(own, config.env.image_size).to(device), ForwardModel(own).to(device)
    stage = LAPOModelStage(
        inverse, forward, source, own.model, validation=config.data.validation, seed=config.seed, device=device
    )
    return Training(
        [Part("baselines.lapo.model", stage, own.model)],
        device,
        lambda metrics: (
            f"{record.name}: {100 * metrics.get('unexplained', float('nan')):.0f} % of the change left on held-out "
            f"pairs, {record.folder}"
        ),
        extra={"episodes": source.episodes},
    )


def _training(config: ExperimentConfig, record: StageRecord, opened: Callable[[], DemonstrationSplit]) -> Training:
    """Latent policy, then action decoder."""
    from playslot_rl.baselines.lapo.behaviour import LAPOBehaviour
    from playslot_rl.baselines.lapo.load import MODEL, NAME
    from playslot_rl.training.fit import Part
    from playslot_rl.training.record import Training

    own, device, split = config.baselines.lapo, open_device(config), opened()
    behaviour = LAPOBehaviour(config, record.parents[MODEL], split, device)
    labelled = {"labelled_demos": config.behaviour.labelled_demos, "inputs": config.behaviour.decoder_inputs}

    def parts() -> Iterator[Part]:
        yield Part(f"{NAME}.policy", behaviour.policy_stage(), own.policy, lr_key="baselines.lapo.policy.optim.lr")
        decoding = replace(own.policy, steps=own.decoder_steps, optim=replace(own.policy.optim, lr=own.decoder_lr))
        yield Part(
            f"{NAME}.action_decoder",
            behaviour.decoder_stage(),
            decoding,
            folder="decoder",
            lr_key="baselines.lapo.decoder_lr",
            identity=labelled,
        )

    demos = split.trained.episodes
    said = f"{NAME}: {demos} demos, {labelled['labelled_demos']} labelled, {held_out_text(split)}"
    return Training(parts(), device, lambda _: f"{said}, {record.folder}", extra={"demos": demos, **labelled})
