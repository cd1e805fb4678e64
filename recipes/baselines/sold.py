"""`playslot train-baseline method=sold run=WORLD out=DIR`: SOLD on the slots of a finished SAVi, by acting.

`run=pretrained` builds on the shipped world model; only its SAVi is used.
"""

from __future__ import annotations

from functools import partial

from playslot_rl.config import ExperimentConfig
from playslot_rl.recipes.baselines.online import online_record, train_and_save
from playslot_rl.recipes.run import open_device, open_run, parent_run, require_parent


def main(config: ExperimentConfig) -> None:
    """Train SOLD into `OUT/sold`; killed, the same command carries on; finished, it says so.

    Raises:
        CheckpointError: no finished slots in `run`, or `out` was begun otherwise.
        ConfigError: an environment without a simulator or a dense reward, or settings that do not fit.
        OutputError, TrainingError: see `playslot_rl.errors`.
    """
    from playslot_rl.baselines.online.requirements import require_online

    own = config.baselines.sold
    require_online(config, own, "sold")  # before anything is written or computed
    run = open_run(config)

    from playslot_rl.baselines.sold.learner import SOLDLearner
    from playslot_rl.baselines.sold.load import NAME, build_networks, prior_steps
    from playslot_rl.seeding import global_seed
    from playslot_rl.training.runs import load_savi, slots_checkpoint, use_world_model

    parent = parent_run(config, run)
    slots = slots_checkpoint(parent)
    require_parent(config, run, slots, "image_size")
    ready = partial(use_world_model, run, parent)
    record = online_record(config, own, run, NAME, ready=ready, parents={"slots": slots})
    if record.finished():
        return
    before = prior_steps(own, slots)
    device = open_device(config)
    with global_seed(config.seed, 0, NAME):
        networks = build_networks(own, slots, config.env.action_dim, config.env.max_steps).to(device)
    learner = SOLDLearner(load_savi(parent, device), networks, own, config.env.action_dim)
    train_and_save(record, own, learner, learner.trained, device, prior_steps=before)
