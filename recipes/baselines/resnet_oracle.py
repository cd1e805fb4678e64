"""`playslot train-baseline method=resnet_oracle data.demos=DEMOS demos=N out=DIR`: clone real actions from frames.

The head's sizes are `model.policy`, the schedule is `baselines.resnet_oracle`.
"""

from __future__ import annotations

from playslot_rl.config import ExperimentConfig, to_dict
from playslot_rl.recipes.run import demo_root, finished, fixed_keys, open_device, open_run, open_videos, store_config


def main(config: ExperimentConfig) -> None:
    """Train the oracle into `OUT/resnet_oracle`; killed, the same command carries on; finished, it says so.

    Raises:
        CheckpointError: no such weights to start from, or `out` was begun otherwise.
        DataError: fewer than `demos` demonstrations, or none with actions.
        OutputError, TrainingError: see `playslot_rl.errors`.
    """
    import torch

    from playslot_rl import keys
    from playslot_rl.baselines.frame_inputs import FrameInputs
    from playslot_rl.baselines.oracles.resnet import NAME, ResNetPolicy, load_pretrained
    from playslot_rl.data.demonstrations import first_demonstrations, real_actions, transitions
    from playslot_rl.losses.behaviour import BehaviourLoss
    from playslot_rl.seeding import derived_seed
    from playslot_rl.storage.checkpoints import checkpoint_folder, save_stage
    from playslot_rl.training.fit import fit
    from playslot_rl.training.stage_regression import RegressionStage

    run, own, demos = open_run(config), config.baselines.resnet_oracle, demo_root(config)
    wanted = {"model": {"policy": to_dict(config.model.policy)}, "behaviour": {"loss": config.behaviour.loss}}
    if finished(config, run, NAME, {**wanted, NAME: fixed_keys(own)}, {}, demos, config.demos):
        return
    device = open_device(config)
    source = first_demonstrations(open_videos(config, demos, "train-baseline"), config.demos)
    moves = transitions(source)
    actions = real_actions(source, moves.rows, config.env.action_dim).to(device)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derived_seed(config.seed, 0, NAME))
        policy = ResNetPolicy(config.model.policy, config.env.image_size, config.env.action_dim)
    pretraining = load_pretrained(policy, own.weights)
    policy.to(device)
    criterion = BehaviourLoss(policy, config.behaviour.loss)
    criterion.set_keys(observation=keys.PIXELS, action=keys.ACTION)
    inputs = FrameInputs(source, moves.rows, device, own.shift)
    stage = RegressionStage(
        "policy", criterion, inputs, actions, own.batch_size, validated=256, precision=own.precision
    )
    result = fit(
        stage,
        own,
        run / NAME,
        name=f"baselines.{NAME}",
        seed=config.seed,
        device=device,
        logging=config.logging,
        identity={**wanted, "data": source.fingerprint, "pretraining": pretraining},
        ready=lambda: store_config(config, run),
    )
    save_stage(
        checkpoint_folder(run, NAME),
        stage=NAME,
        modules=stage.modules,
        config={
            "env": to_dict(config.env),
            "model": to_dict(config.model),
            "behaviour": to_dict(config.behaviour),
            NAME: to_dict(own),
        },
        data={"demos": source.fingerprint},
        parents={},
        metrics=result.metrics,
        steps=result.step,
        seconds=result.seconds,
        extra={
            "demos": len(moves.lengths),
            "labelled_demos": len(moves.lengths),
            "pretraining": pretraining,
            "seed": config.seed,
        },
    )
    print(f"{NAME}: {len(moves.lengths)} demos, all labelled, ResNet-18 from {pretraining}, {run / NAME}", flush=True)
