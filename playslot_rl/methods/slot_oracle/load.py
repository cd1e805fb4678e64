"""The Slot Oracle: PlaySlot's policy network on a frozen SAVi's slots, cloning real actions (paper, section 4).

    a_t = clamp(f(S_t), -1, 1),   L = mean |f(S_t) - a_t|  (or squared, `behaviour.loss`)

The same network and training as the reference inside stage 3, but a run of its own: all its demonstrations lend their
real actions.
"""

from __future__ import annotations

import torch

from playslot_rl.acting.actor import Actor, SlotActor
from playslot_rl.methods.slot_oracle.method import NAME
from playslot_rl.runs import Run
from playslot_rl.world_model import oracle_module, untrained_oracle


def load_actor(run: Run, device: torch.device | str = "cpu") -> Actor:
    """The actor of a run; a CheckpointError where it or its SAVi is missing, damaged, or of other slots."""
    done, savi = run.stage(NAME, "slots"), run.load_savi(device)
    model, env = done.sizes
    oracle = done.restore(lambda: untrained_oracle(model.policy, savi.config.slot_dim, env), "oracle", device)
    return SlotActor(savi, oracle_module(oracle), policy=oracle)
