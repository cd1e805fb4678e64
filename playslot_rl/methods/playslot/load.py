"""A run of PlaySlot: its policy as an actor, its world model as a predictor of frames."""

from __future__ import annotations

import torch

from playslot_rl.acting.actor import SlotActor
from playslot_rl.acting.agent import playslot_actor
from playslot_rl.methods.video.predictor import SlotVideo
from playslot_rl.runs import Run


def load_actor(run: Run, device: torch.device | str = "cpu") -> SlotActor:
    """The actor of a run; a CheckpointError where a stage is missing or damaged, or was trained on other parents."""
    return playslot_actor(run.load_agent(device))


def load_video(run: Run, device: torch.device | str = "cpu") -> SlotVideo:
    return SlotVideo(run.load_world_model(device))
