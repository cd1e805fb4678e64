"""`playslot train-baseline method=lapo data.root=VIDEOS data.demos=DEMOS demos=N out=DIR`: LAPO.

Inverse and forward model on the videos, a latent policy on the demonstrations' videos, an action decoder on the real
actions of `behaviour.labelled_demos` of them. `baselines.lapo.world=RUN` takes the models of another run.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from playslot_rl.config import ExperimentConfig, StageConfig, to_dict
from playslot_rl.recipes.run import demo_root, finished, fixed_keys, open_device, open_run, open_videos, store_config

if TYPE_CHECKING:
    from playslot_rl.storage.checkpoints import StageCheckpoint


def main(config: ExperimentConfig) -> None:
    """Train LAPO into `OUT/lapo_model` and `OUT/lapo`; killed, the same command carries on; finished, it says so.

    Raises:
        CheckpointError: `out` was begun otherwise, or `baselines.lapo.world` is no finished model of these sizes.
        DataError: no videos, too few demonstrations, or none with actions.
        OutputError, TrainingError: see `playslot_rl.errors`.
    """
    from playslot_rl.baselines.lapo.load import MODEL, NAME, given_model
    from playslot_rl.data.demonstrations import first_demonstrations, require_labelled
    from playslot_rl.training.runs import adopt_stage

    run, own, demos = open_run(config), config.baselines.lapo, demo_root(config)
    source = first_demonstrations(open_videos(config, demos, "train-baseline"), config.demos)
    source.require_actions(config.env.action_dim)
    require_labelled(config.behaviour.labelled_demos, source.episodes)  # before anything is computed
    model = given_model(own, config.env.image_size, run) if own.world else train_model(config, run)
    wanted = {
        "model": {"action_decoder": to_dict(config.model.action_decoder)},
        "behaviour": {key: to_dict(config.behaviour)[key] for key in ("labelled_demos", "decoder_inputs")},
        NAME: {key: value for key, value in to_dict(own).items() if key not in ("model", "policy", "world")}
        | {"policy": fixed_keys(own.policy)},
    }
    if finished(config, run, NAME, wanted, {MODEL: model}, demos, config.demos):
        return
    store_config(config, run)  # first: it is what marks the folder as a run, should a kill come in between
    if own.world:
        adopt_stage(model, run)
    _train_policy(config, run, model)


def train_model(config: ExperimentConfig, run: Path) -> StageCheckpoint:
    """Train inverse and forward model on `data.root` into `RUN/lapo_model`, or find them there.

    Raises:
        CheckpointError, DataError, OutputError, TrainingError: see `playslot_rl.errors`.
    """
    import torch

    from playslot_rl.baselines.lapo.load import MODEL, NAME, sizes_of
    from playslot_rl.baselines.lapo.model import ForwardModel, InverseModel
    from playslot_rl.baselines.lapo.stage import LAPOModelStage
    from playslot_rl.seeding import derived_seed
    from playslot_rl.storage.checkpoints import checkpoint_folder, read_stage, save_stage
    from playslot_rl.training.fit import fit

    own = config.baselines.lapo
    sizes = {NAME: sizes_of(own)}
    trained_as = {NAME: {**sizes[NAME], "model": fixed_keys(own.model)}}
    if finished(config, run, MODEL, trained_as, {}, config.data.root):
        return read_stage(checkpoint_folder(run, MODEL), MODEL)
    device = open_device(config)
    source = open_videos(config, config.data.root, "train-baseline")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derived_seed(config.seed, 0, MODEL))
        inverse, forward = InverseModel(own, config.env.image_size).to(device), ForwardModel(own).to(device)
    stage = LAPOModelStage(
        inverse, forward, source, own.model, validation=config.data.validation, seed=config.seed, device=device
    )
    result = fit(
        stage,
        own.model,
        run / MODEL,
        name="baselines.lapo.model",
        seed=config.seed,
        device=device,
        logging=config.logging,
        identity={**sizes, "data": source.fingerprint, "data.validation": config.data.validation},
        ready=lambda: store_config(config, run),
    )
    values = {"env": to_dict(config.env), "model": to_dict(config.model), NAME: to_dict(own)}
    extra = {"episodes": source.episodes, "seed": config.seed}
    left = result.metrics.get("unexplained", float("nan"))
    print(f"{MODEL}: {100 * left:.0f} % of the change left on held-out pairs, {run / MODEL}", flush=True)
    return save_stage(
        checkpoint_folder(run, MODEL),
        stage=MODEL,
        modules=stage.modules,
        config=values,
        data={"train": source.fingerprint},
        parents={},
        metrics=result.metrics,
        steps=result.step,
        seconds=result.seconds,
        extra=extra,
    )


def _train_policy(config: ExperimentConfig, run: Path, model: StageCheckpoint) -> None:
    """Latent policy, then action decoder."""
    from playslot_rl.baselines.lapo.behaviour import LAPOBehaviour
    from playslot_rl.baselines.lapo.load import MODEL, NAME, sizes_of
    from playslot_rl.data.demonstrations import first_demonstrations
    from playslot_rl.storage.checkpoints import checkpoint_folder, save_stage
    from playslot_rl.training.fit import FitResult, Stage, fit

    own, device = config.baselines.lapo, open_device(config)
    source = first_demonstrations(open_videos(config, demo_root(config), "train-baseline"), config.demos)
    behaviour = LAPOBehaviour(config, model, source, device)
    sizes = {"action_decoder": to_dict(config.model.action_decoder), NAME: sizes_of(own)}
    labelled = {"labelled_demos": config.behaviour.labelled_demos, "inputs": config.behaviour.decoder_inputs}
    identity = {**sizes, "data": source.fingerprint, MODEL: model.fingerprint, "loss": own.loss, "shift": own.shift}

    def train(stage: Stage, part: StageConfig, folder: Path, more: dict[str, object]) -> FitResult:
        return fit(
            stage,
            part,
            folder,
            name=f"{NAME}.{next(iter(stage.modules))}",
            seed=config.seed,
            device=device,
            logging=config.logging,
            identity={**identity, **more},
            rate="baselines.lapo.policy.optim.lr" if folder == run / NAME else "baselines.lapo.decoder_lr",
        )

    cloned = train(behaviour.policy_stage(), own.policy, run / NAME, {})
    decode = replace(own.policy, steps=own.decoder_steps, optim=replace(own.policy.optim, lr=own.decoder_lr))
    decoded = train(behaviour.decoder_stage(), decode, run / NAME / "decoder", dict(labelled))
    save_stage(
        checkpoint_folder(run, NAME),
        stage=NAME,
        modules=behaviour.modules,
        config={
            "env": to_dict(config.env),
            "model": to_dict(config.model),
            "behaviour": to_dict(config.behaviour),
            NAME: to_dict(own),
        },
        data={"demos": source.fingerprint},
        parents={MODEL: model.fingerprint},
        metrics={**cloned.metrics, **{f"decoder_{key}": value for key, value in decoded.metrics.items()}},
        steps=cloned.step,
        seconds=cloned.seconds + decoded.seconds,
        extra={"demos": source.episodes, **labelled, "seed": config.seed},
    )
    print(f"{NAME}: {source.episodes} demos, {labelled['labelled_demos']} labelled, {run / NAME}", flush=True)
