"""The networks of VPT on slots, and its actor, the policy alone."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import torch

from playslot_rl.acting.actor import Actor, SlotActor
from playslot_rl.config import EnvConfig, PolicyConfig
from playslot_rl.methods.slot_vpt.method import NAME
from playslot_rl.modules.policy import LatentPolicy
from playslot_rl.runs import Run
from playslot_rl.world_model import oracle_module, untrained_oracle

TWO: Final = ("labeller", "oracle")
"""As they are stored; the policy is the Slot Oracle's network."""


def networks(sizes: PolicyConfig, slot_dim: int, env: EnvConfig) -> tuple[LatentPolicy, LatentPolicy]:
    """Labeller, of slots and their change beside each other, and policy, untrained."""
    policy = untrained_oracle(sizes, slot_dim, env)
    return LatentPolicy(replace(sizes, goal=False), 2 * slot_dim, env.action_dim), policy


def load_actor(run: Run, device: torch.device | str = "cpu") -> Actor:
    """The actor of a run; a CheckpointError where it or its SAVi is missing, damaged, or of other slots."""
    done, savi = run.stage(NAME, "slots"), run.load_savi(device)
    model, env = done.sizes
    _, policy = done.restore_several(TWO, lambda: networks(model.policy, savi.config.slot_dim, env), device)
    return SlotActor(savi, oracle_module(policy), policy=policy)
