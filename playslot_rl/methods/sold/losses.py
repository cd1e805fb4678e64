"""SOLD's imagined rollouts, and its losses on plain tensors (Mosbach et al., 2025, sections 3.2 and 3.3; DreamerV3's
returns and critic).

    a_t ~ pi(. | sg(S_1, ..., S_t)),   S_{t+1} = dynamics(S_1, ..., S_t, a_1, ..., a_t)

Note: the source's actor learns from all returns but the last one. That with `reinforce` has the wrong sign there.

Shapes: B sequences of T frames or rollouts, C context frames, H imagined steps, N slots, D slot width, A action width,
K bins.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from torch import Tensor
from torch.distributions import Normal
from torchrl.objectives.value.functional import td_lambda_return_estimate

from playslot_rl.methods.sold.networks import ActorHead, ScalarHead, sample_action
from playslot_rl.modules.predictors.ocvp_seq import OCVPSeq


class Imagined(NamedTuple):
    """A batch of imagined rollouts.

    Attributes:
        slots: (B, C + H, N, D); the context, then what follows from the actions. Differentiable in the actions.
        actions: (B, H, A), reparameterised, not clamped.
        log_probs, entropies: (B, H), summed over A; those of the actions as constants.
        locations: (B, H, A), the means of the actions' distributions, as constants.
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
    """Unfold H steps from the last frame of parsed slots (B, C, N, D), between which `actions` (B, C - 1, A) were
    taken.

    The actor reads slots without their gradient (as in Dreamer): an action is judged by what the dynamics make of it.
    It sees all frames so far, by the keys and values of those before: a step costs one step.
    """
    memory = None
    if context.shape[1] > 1:
        with torch.no_grad():  # no action that is judged leads there
            _, memory = dynamics.step(context[:, :-1], actions)
    frames, chosen, log_probs, entropies, locations = [context], [], [], [], []
    current, new, past = context[:, -1:], context, None
    for _ in range(horizon):
        mean, std, past = actor(new.detach(), past)
        mean, std = mean[:, -1:], std[:, -1:]
        action = sample_action(mean, std, generator)
        distribution = Normal(mean, std, validate_args=False)  # what is validated is waited for
        new, memory = dynamics.step(current, action, past=memory)
        current = new
        frames.append(new)
        chosen.append(action)
        log_probs.append(distribution.log_prob(action.detach()).sum(dim=-1))
        entropies.append(distribution.entropy().sum(dim=-1))
        locations.append(mean.detach())
    return Imagined(*(torch.cat(parts, dim=1) for parts in (frames, chosen, log_probs, entropies, locations)))


def same_episode(is_first: Tensor) -> Tensor:
    """Frames that belong to the sequence's first episode: is_first (B, T) to bool (B, T)."""
    later = is_first.clone()
    later[:, 0] = False
    return later.long().cumsum(dim=1) == 0


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean of values (B, T) where mask (B, T) is True; zero where it never is."""
    return torch.where(mask, values, 0.0).sum() / mask.sum().clamp(min=1)


def slot_loss(predicted: Tensor, slots: Tensor, valid: Tensor) -> Tensor:
    """Mean squared error of predicted slots (B, T, N, D) on the frames that `valid` (B, T) names."""
    return masked_mean((predicted - slots).square().mean(dim=(-2, -1)), valid)


def imagined_returns(rewards: Tensor, values: Tensor, gamma: float, lmbda: float) -> Tensor:
    """Lambda returns R_0 ... R_{H-1} (B, H) of rewards r_1 ... r_H and values v_1 ... v_H, each (B, H).

    R_t = r_{t+1} + gamma ((1 - lambda) v_{t+1} + lambda R_{t+1}), with R_H = v_H (DreamerV3, Eq. "lambda return").
    Imagined trajectories never end, so there is no continuation flag.
    """
    over = torch.zeros_like(rewards, dtype=torch.bool).unsqueeze(-1)
    returns: Tensor = td_lambda_return_estimate(
        gamma, lmbda, values.unsqueeze(-1), rewards.unsqueeze(-1), done=over, terminated=over
    )
    return returns.squeeze(-1)


def actor_loss(
    imagined: Imagined,
    returns: Tensor,
    baselines: Tensor,
    scale: Tensor,
    weights: Tensor,
    entropy: float,
    gradient: Literal["dynamics", "reinforce"],
) -> Tensor:
    """-E[w_t (R_t / S)] - entropy E[w_t H_t], or with `reinforce` -E[w_t log pi(a_t) sg((R_t - v_t) / S)] - ...

    Args:
        returns: R_0 ... R_{H-1} (B, H), differentiable in the actions for `dynamics`.
        baselines: v_0 ... v_{H-1} (B, H).
        scale: S, a number of at least 1.
        weights: w (H,), gamma^0 ... gamma^(H-1): how much an imagined step weighs.
    """
    if gradient == "dynamics":
        objective = returns / scale
    else:
        objective = imagined.log_probs * ((returns - baselines) / scale).detach()
    return -(weights * (objective + entropy * imagined.entropies)).mean()


def value_loss(
    head: ScalarHead, logits: Tensor, returns: Tensor, slow: Tensor, weights: Tensor, slow_weight: float
) -> Tensor:
    """Cross entropy of the critic's logits (B, H, K) and the returns (B, H), and `slow_weight` times that with what the
    slow critic says (B, H), both without gradient, weighed by w (H,).
    """
    to_slow = head.cross_entropy(logits, slow)
    return (weights * (head.cross_entropy(logits, returns) + slow_weight * to_slow)).mean()
