"""SOLD from disk, and what its world model cost in agent steps."""

from __future__ import annotations

from pathlib import Path

import torch

from playslot_rl.baselines.sold.acting import SOLDActor
from playslot_rl.baselines.sold.networks import SOLDNetworks, acting_window
from playslot_rl.config import from_dict
from playslot_rl.config.baselines import SOLDConfig
from playslot_rl.errors import CheckpointError, ConfigError
from playslot_rl.storage.checkpoints import (
    StageCheckpoint,
    checkpoint_folder,
    load_weights,
    read_stage,
    require_parents,
)
from playslot_rl.training.runs import load_savi, run_folder, stage_model, world_model_folder

NAME = "sold"


def build_networks(config: SOLDConfig, slots: StageCheckpoint, action_dim: int, max_steps: int) -> SOLDNetworks:
    """Fresh networks for the slots of a finished SAVi.

    Args:
        config: sizes.
        slots: SAVi's checkpoint.
        action_dim: A.
        max_steps: agent steps in an episode, which a `sequence` of 0 takes whole.
    """
    slot_dim = stage_model(slots)[0].savi.slot_dim
    return SOLDNetworks(config, slot_dim, action_dim, config.sequence or max_steps + 1)


def slots_checkpoint(run: Path | str) -> StageCheckpoint:
    """The finished SAVi that a run builds on.

    Raises:
        CheckpointError: there is none.
    """
    return read_stage(checkpoint_folder(world_model_folder(run), "slots"), "slots")


def prior_steps(config: SOLDConfig, slots: StageCheckpoint) -> int:
    """Agent steps of the data that SAVi was trained on, which count as SOLD's own.

    `savi_steps` of the config if given; else what the checkpoint says. One written before it said so names its episodes
    only: their number times `env.max_steps`, which is what `playslot pipeline` records.

    Raises:
        ConfigError: the checkpoint says neither.
    """
    if config.savi_steps is not None:
        return config.savi_steps
    steps, episodes = slots.meta.get("agent_steps"), slots.meta.get("episodes")
    if steps is not None:
        return int(steps)
    if episodes is None:
        raise ConfigError(
            f"baselines.sold.savi_steps: got nothing, and {slots.path}/meta.json names neither agent_steps nor "
            "episodes: say how many agent steps SAVi's data hold"
        )
    return int(episodes) * stage_model(slots)[1].max_steps


def load_actor(run: Path | str, device: torch.device | str = "cpu") -> SOLDActor:
    """SOLD's policy of a run, in evaluation mode.

    Raises:
        CheckpointError: the run has no finished SOLD, a damaged one, or another SAVi than it was trained on.
    """
    checkpoint = read_stage(checkpoint_folder(run_folder(run), NAME), NAME)
    slots = slots_checkpoint(run)
    require_parents(checkpoint, {"slots": slots})
    try:
        config = from_dict(SOLDConfig, checkpoint.config[NAME], f"baselines.{NAME}.")
        action_dim = int(checkpoint.config["env"]["action_dim"])
        max_steps = int(checkpoint.config["env"]["max_steps"])
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"{checkpoint.path}/config.json: {error}; expected the config of this version of playslot_rl: train again"
        ) from error
    with torch.random.fork_rng(devices=[]):
        networks = build_networks(config, slots, action_dim, max_steps)
    load_weights(checkpoint, networks.parts)
    networks.to(device).eval().requires_grad_(False)
    actor = SOLDActor(load_savi(run, device), networks.actor, acting_window(config), action_dim)
    actor.eval()
    return actor
