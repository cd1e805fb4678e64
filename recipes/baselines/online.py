"""`playslot train-baseline method=dreamer|sold env=E out=DIR`: a method that learns by acting in the task.

DreamerV3 sees pixels. SOLD (`run=WORLD`) sees the slots of a finished SAVi; `run=pretrained` takes that of the shipped
world model.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.methods import METHODS
from playslot_rl.recipes.run import open_device, open_run, parent_run, require_parent

if TYPE_CHECKING:
    import torch
    from torch import nn

    from playslot_rl.methods.online.checkpoints import OnlineState
    from playslot_rl.methods.online.learner import Learner
    from playslot_rl.training.record import StageRecord


def main(config: ExperimentConfig) -> None:
    """Train `config.method` into `OUT/METHOD`; killed, the same command carries on; finished, it says so.

    Raises:
        ConfigError: an environment without a simulator or without a dense reward, or settings that do not fit.
        CheckpointError: no finished slots in `run`, or `out` was begun otherwise.
        OutputError, TrainingError: see `playslot_rl.errors`.
    """
    from playslot_rl.methods.online.requirements import require_online

    name = config.method
    own = config.baselines.dreamer if name == "dreamer" else config.baselines.sold
    require_online(config, own, name)  # before anything is written or computed
    run = open_run(config)

    from playslot_rl.methods.dreamer import method as dreamer
    from playslot_rl.methods.online.loop import train_online
    from playslot_rl.methods.sold import method as sold
    from playslot_rl.storage.atomic import write_bytes
    from playslot_rl.storage.checkpoints import StageCheckpoint
    from playslot_rl.training.record import StageRecord
    from playslot_rl.training.runs import slots_checkpoint, use_world_model
    from playslot_rl.visualization.charts import DARK, LIGHT, learning_chart

    parent, parents = parent_run(config, run), dict[str, StageCheckpoint]()
    if METHODS[name].slots:
        parents["slots"] = slots_checkpoint(parent)
        require_parent(config, run, parents["slots"], "image_size")
    record = StageRecord(
        dreamer.STAGE if name == "dreamer" else sold.STAGE,
        run,
        config,
        parents=parents,
        ready=partial(use_world_model, run, parent) if parents else lambda: None,
    )
    if record.finished():
        return
    device = open_device(config)
    learner, modules, prior = _sold(record, parent, device) if parents else _dreamer(record, device)
    state, _ = train_online(learner, own, record, title=METHODS[name].title, device=device, prior_steps=prior)
    for theme in (LIGHT, DARK):
        chart = learning_chart({name: state.curve}, state.random, theme)
        write_bytes(record.folder / f"curve_{theme.name}.png", chart)
    _save(record, state, modules, prior)


def _dreamer(record: StageRecord, device: torch.device) -> tuple[Learner, dict[str, nn.Module], int]:
    """The learner, what a finished run keeps of it, and the agent steps behind what it was given."""
    from playslot_rl.methods.dreamer.learner import DreamerLearner
    from playslot_rl.methods.dreamer.networks import DreamerNetworks
    from playslot_rl.seeds.draws import global_seed

    config, own = record.config, record.config.baselines.dreamer
    with global_seed(config.seed, 0, record.name):
        networks = DreamerNetworks(own, config.env).to(device)
        return DreamerLearner(networks, own), {"networks": networks}, 0


def _sold(record: StageRecord, parent: str, device: torch.device) -> tuple[Learner, dict[str, nn.Module], int]:
    """As `_dreamer`."""
    from playslot_rl.methods.sold.actor import build_networks, prior_steps
    from playslot_rl.methods.sold.learner import SOLDLearner
    from playslot_rl.seeds.draws import global_seed
    from playslot_rl.training.runs import load_savi

    config, own, slots = record.config, record.config.baselines.sold, record.parents["slots"]
    before = prior_steps(own, slots)
    with global_seed(config.seed, 0, record.name):
        networks = build_networks(own, slots, config.env.action_dim, config.env.max_steps).to(device)
    learner = SOLDLearner(load_savi(parent, device), networks, own, config.env.action_dim)
    return learner, dict(learner.trained), before


def _save(record: StageRecord, state: OnlineState, modules: dict[str, nn.Module], prior: int) -> None:
    extra = {
        "env_steps": state.step + prior,
        "savi_steps": prior,
        "episodes": state.episodes,
        "random_policy": state.random,
        "parameters": sum(p.numel() for module in modules.values() for p in module.parameters()),
    }
    record.save(modules, state.metrics, state.updates, state.seconds, extra)
    last, random, before = state.curve[-1], state.random, f" and {prior} of SAVi's data" if prior else ""
    print(
        f"{record.name}: {state.step} agent steps{before}, {state.updates} updates; development episodes: return "
        f"{last['return_mean']:.2f} (random {random['return_mean']:.2f}), success {100 * last['success_rate']:.0f} % "
        f"(random {100 * random['success_rate']:.0f} %); {record.folder}",
        flush=True,
    )
