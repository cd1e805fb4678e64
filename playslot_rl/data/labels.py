"""Demonstrations labelled by a frozen world model: latent actions, and slots as they are imagined.

Shapes: B episodes of T transitions, M transitions of all demonstrations, N slots, D slot width, Z latent-action width,
F frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from playslot_rl.data.cache import note_read
from playslot_rl.data.demonstrations import BY_ROW, Demonstrations, moving_slots, real_actions, transitions
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.world_model import WorldModel

BATCH = 64  # episodes labelled at once


@torch.no_grad()
def label_demonstrations(
    model: WorldModel,
    source: EpisodeFrames,
    slots: npt.NDArray[np.float32],
    device: torch.device | str = "cpu",
    trim: float = 0.0,
    margin: int = 0,
) -> Demonstrations:
    """Infer the latent actions of demonstration videos, and unfold each in imagination under them.

    Stretches in which nothing moves are left out (`moving_rows`), and never held: the labels of 260,000 transitions of
    eight slots are 1.1 GB.

    Args:
        trim: motion of the slots up to which a transition is still; 0 keeps every one.
        margin: still ones kept after each stretch of motion.

    Raises:
        DataError: no episode has two frames, nothing moves, mode `ground_truth` without actions, or actions of another
            width.
    """
    moves = transitions(source)
    moving = moving_slots(moves, slots, trim, margin)
    first, episodes = np.cumsum(moves.lengths) - moves.lengths, np.nonzero(source.lengths >= 2)[0]
    of_kept = np.full(len(moves.rows), -1)  # where each transition goes; -1: nowhere
    of_kept[first[moving.episode] + moving.step] = np.arange(len(moving.rows))
    actions = None if source.actions is None else real_actions(source, moving.rows, model.env.action_dim).to(device)
    labels: tuple[Tensor, ...] = ()
    for steps in np.unique(moves.lengths):
        same = np.nonzero(moves.lengths == steps)[0]
        for chosen in np.array_split(same, -(-len(same) // BATCH)):
            frames = source.starts[episodes[chosen]][:, None] + np.arange(steps + 1)
            places = torch.from_numpy(of_kept[first[chosen][:, None] + np.arange(steps)])
            found, kept = _label(model, source, slots, frames, device), places >= 0
            # Filled in: pieces that are joined in the end would need twice the memory.
            labels = labels or tuple(part.new_empty(len(moving.rows), *part.shape[2:]) for part in found)
            for whole, part in zip(labels, found, strict=True):
                whole[places[kept]] = part[kept]
    parsed, imagined, latents = labels
    return Demonstrations(
        slots=parsed,
        imagined=imagined,
        latents=latents,
        actions=actions,
        episode=torch.from_numpy(moving.episode).to(device),
        step=torch.from_numpy(moving.step).to(device),
        lengths=torch.from_numpy(moving.lengths),
    )


def _label(
    model: WorldModel,
    source: EpisodeFrames,
    slots: npt.NDArray[np.float32],
    frames: npt.NDArray[np.int64],
    device: torch.device | str,
) -> tuple[Tensor, Tensor, Tensor]:
    """Parsed and imagined slots (B, T, N, D) and latents (B, T, Z) of episodes of equal length, frames (B, T + 1)."""
    read = slots[frames]
    note_read(read.nbytes)
    parsed, actions = torch.from_numpy(read).to(device), None
    if model.inverse_dynamics.config.mode == "ground_truth":
        actions = torch.from_numpy(source.require_actions()[frames[:, :-1]]).to(device)
    latent = model.inverse_dynamics(parsed, actions)
    rolled = model.predictor.rollout(parsed[:, :1], latent.prototype, latent.variability)
    return parsed[:, :-1], torch.cat((parsed[:, :1], rolled[:, :-1]), dim=1), latent.mean


def with_copies(demos: Sequence[Demonstrations]) -> Demonstrations:
    """Demonstrations, and shifted copies of them after them, as one set."""
    first, *copies = demos
    if not copies:
        return first
    there = [name for name in BY_ROW if getattr(first, name) is not None]
    return replace(first, **{name: torch.cat([getattr(copy, name) for copy in demos]) for name in there})
