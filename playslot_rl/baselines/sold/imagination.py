"""Imagined rollouts of the actor in the slot dynamics (Mosbach et al., 2025, section 3.3).

    a_t ~ pi(. | sg(S_1, ..., S_t)),   S_{t+1} = dynamics(S_1, ..., S_t, a_1, ..., a_t)

Shapes: B windows, C context frames, H imagined steps, N slots, D slot width, A action width.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from playslot_rl.baselines.sold.heads import ActorHead, action_distribution, sample_action
from playslot_rl.modules.predictors.ocvp_seq import OCVPSeq


class Imagined(NamedTuple):
    """A batch of imagined rollouts.

    Attributes:
        slots: (B, C + H, N, D); the context, then what follows from the actions. Differentiable in the actions.
        actions: (B, H, A) in [-1, 1], reparameterised.
        log_probs: (B, H) of the actions, as constants, summed over A.
        entropies: (B, H), summed over A.
        locations: (B, H, A), the modes of the actions' distributions, as constants.
    """

    slots: Tensor
    actions: Tensor
    log_probs: Tensor
    entropies: Tensor
    locations: Tensor


def imagine(
    dynamics: OCVPSeq,
    actor: ActorHead,
    context: Tensor,
    actions: Tensor,
    horizon: int,
    generator: torch.Generator | None = None,
) -> Imagined:
    """Unfold H steps from the context's last frame.

    The actor reads slots without their gradient (as in Dreamer): an action is judged by what the dynamics make of it.

    Args:
        dynamics: predicts the next frame's slots.
        actor: chooses the actions.
        context: parsed slots (B, C, N, D).
        actions: (B, C - 1, A) taken between them.
        horizon: H.
        generator: of the sampled actions.
    """
    memory = None
    if context.shape[1] > 1:
        with torch.no_grad():  # no action that is judged leads there
            _, memory = dynamics.step(context[:, :-1], actions)
    location, std, past = actor(context.detach())
    frames, chosen, log_probs, entropies, locations = [context], [], [], [], []
    current = context[:, -1:]
    for step in range(horizon):
        distribution = action_distribution(location[:, -1:], std[:, -1:])
        action = sample_action(distribution, generator)
        current, memory = dynamics.step(current, action, past=memory)
        frames.append(current)
        chosen.append(action)
        log_probs.append(distribution.log_prob(action.detach()))
        entropies.append(distribution.base_dist.entropy().sum(dim=-1))
        locations.append(location[:, -1:].detach())
        if step + 1 < horizon:
            location, std, past = actor(current.detach(), past)
    return Imagined(*(torch.cat(parts, dim=1) for parts in (frames, chosen, log_probs, entropies, locations)))
