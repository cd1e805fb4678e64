"""What the recipes share of methods that clone the latent actions of a model of unlabelled videos."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from playslot_rl.config import ExperimentConfig, StageConfig
from playslot_rl.config.methods import LATENT_MODELS
from playslot_rl.recipes.run import require_parent

if TYPE_CHECKING:
    from playslot_rl.data.demonstrations import DemonstrationSplit
    from playslot_rl.methods.cloning import LatentCloning
    from playslot_rl.storage.checkpoints import StageCheckpoint
    from playslot_rl.training.fit import Part
    from playslot_rl.training.record import StageRecord, Training


def model_of(
    config: ExperimentConfig,
    run: Path,
    stage: str,
    world: str,
    train: Callable[[ExperimentConfig, Path], StageCheckpoint],
    demos: DemonstrationSplit,
    labelled: int | None = None,
    sizes: Mapping[str, Any] | None = None,
) -> StageCheckpoint:
    """The model that a method builds on: of another run, or trained on `data.root` into its own.

    Args:
        config: of the command.
        run: the method's run.
        stage: the model's, one of `LATENT_MODELS`.
        world: the other run; empty trains.
        train: trains the model into a run, or finds it there.
        demos: what the method will clone; looked at before a model is trained for it.
        labelled: how many of them show their actions; None: all.
        sizes: parts of the config that another run's model must share.

    Raises:
        CheckpointError: no finished model there, one of other frames or sizes, or `run` has another one of its own.
        DataError: fewer than `labelled`, or nothing moves in `demos`, in the labelled ones, or in those held out.
        OutputError, TrainingError: see `playslot_rl.errors`.
    """
    from playslot_rl.data.demonstrations import require_finite, require_labelled
    from playslot_rl.errors import CheckpointError
    from playslot_rl.storage.checkpoints import checkpoint_folder, read_stage, require_config, require_whole

    if labelled is not None:
        require_labelled(labelled, demos.trained.episodes)
    require_finite(demos, labelled)
    if not world:
        if not (checkpoint_folder(run, stage) / "meta.json").is_file():
            _require_moving(config, demos, labelled)
        return train(config, run)
    folder = checkpoint_folder(Path(world), stage)
    if not (folder / "meta.json").is_file():
        raise CheckpointError(
            f"baselines.{config.method}.world={world}: got no {folder}, expected a run with {LATENT_MODELS[stage]}: "
            "name another, or leave it out to train one"
        )
    model = read_stage(folder, stage)
    require_whole(model)
    require_parent(config, run, model, "image_size")
    require_config(model, sizes or {})
    return model


def _require_moving(config: ExperimentConfig, demos: DemonstrationSplit, labelled: int | None) -> None:
    from playslot_rl.data.demonstrations import labelled_rows, moving_frames

    threshold, margin = config.behaviour.trim_pixels, config.behaviour.trim_margin
    moves = moving_frames(demos.trained, threshold, margin)
    if labelled is not None:
        labelled_rows(moves.episode, labelled)
    if demos.held_out is not None:
        moving_frames(demos.held_out, threshold, margin)


def cloning(
    config: ExperimentConfig,
    record: StageRecord,
    behaviour: LatentCloning,
    policy: StageConfig,
    decoder_steps: int,
    decoder_lr: float,
) -> Training:
    """Latent policy, then action decoder; the policy is taken over where another run has trained it.

    Args:
        config: of the command.
        record: the method's stage.
        behaviour: what is trained.
        policy: its schedule, `baselines.METHOD.policy`.
        decoder_steps, decoder_lr: the decoder's; the rest is as for the policy.
    """
    from playslot_rl.training.demonstrated import cloned, policy_taken_over
    from playslot_rl.training.fit import Part
    from playslot_rl.training.record import Training

    name, split = record.name, record.demos
    decoding = replace(policy, steps=decoder_steps, optim=replace(policy.optim, lr=decoder_lr))
    labelled = {"labelled_demos": config.behaviour.labelled_demos, "inputs": config.behaviour.decoder_inputs}

    def parts() -> Iterator[Part]:
        group = f"baselines.{name}"
        yield Part(f"{name}.policy", behaviour.policy_stage(), policy, group=f"{group}.policy")
        yield Part(
            f"{name}.action_decoder",
            behaviour.decoder_stage(),
            decoding,
            folder="decoder",
            group=f"{group}.policy",
            renamed={"steps": f"{group}.decoder_steps", "optim.lr": f"{group}.decoder_lr"},
            identity=labelled,
        )

    said, extra = cloned(name, split, len(behaviour.trained.actions), config.behaviour.labelled_demos)
    return Training(
        parts(),
        behaviour.device,
        lambda _: f"{said}, {record.folder}",
        extra={**extra, **labelled},
        adopt=policy_taken_over(config, record, policy.steps),
    )
