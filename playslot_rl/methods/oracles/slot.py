"""The Slot Oracle: PlaySlot's policy network on a frozen SAVi's slots, cloning real actions (paper, section 4).

    a_t = clamp(f(S_t), -1, 1),   L = mean |f(S_t) - a_t|  (or squared, `behaviour.loss`)

It is the same network and training as the reference inside stage 3 (`playslot_rl.training.stage_behaviour`), but a run
of its own: all its demonstrations lend their real actions.
"""

from __future__ import annotations

from pathlib import Path

import torch

from playslot_rl.acting.actor import Actor, SlotActor
from playslot_rl.modules.policy import LatentPolicy
from playslot_rl.storage.checkpoints import checkpoint_folder, load_weights, read_stage, require_parents
from playslot_rl.training.runs import freeze_on, load_savi, stage_model, world_model_folder
from playslot_rl.world_model import oracle_module

NAME = "slot_oracle"


def load_actor(run: Path, device: torch.device | str = "cpu") -> Actor:
    """The actor of a finished run.

    Raises:
        CheckpointError: the run or its SAVi is missing or damaged, or it was trained on other slots.
    """
    done = read_stage(checkpoint_folder(run, NAME), NAME)
    slots = read_stage(checkpoint_folder(world_model_folder(run), "slots"), "slots")
    require_parents(done, {"slots": slots})
    savi = load_savi(run, device)
    model, env = stage_model(done)
    with torch.random.fork_rng(devices=[]):
        oracle = LatentPolicy(model.policy, savi.config.slot_dim, env.action_dim, acts=True)
    load_weights(done, {"oracle": oracle})
    freeze_on(oracle, device)
    return SlotActor(savi, oracle_module(oracle))
