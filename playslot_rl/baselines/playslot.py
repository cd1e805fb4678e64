"""PlaySlot as an actor: parse, latent policy, action decoder (closed loop).

Acts as `playslot_rl.acting.controllers.ClosedLoop` does (tested), so that it can be compared with the baselines.
"""

from __future__ import annotations

from pathlib import Path

import torch

from playslot_rl.acting.actor import Actor
from playslot_rl.acting.slot_actor import SlotActor
from playslot_rl.world_model import Agent, action_decoder_module, latent_policy_module


def playslot_actor(agent: Agent) -> Actor:
    """The actor of an agent in evaluation mode."""
    return SlotActor(
        agent.world_model.savi, latent_policy_module(agent.policy), action_decoder_module(agent.action_decoder)
    )


def load_actor(run: Path, device: torch.device | str = "cpu") -> Actor:
    """The actor of a run with a trained policy.

    Raises:
        CheckpointError: a stage is missing or damaged.
    """
    from playslot_rl.training.runs import load_agent

    return playslot_actor(load_agent(run, device))
