"""SOLD's losses on plain tensors (Mosbach et al., 2025, sections 3.2 and 3.3; DreamerV3's returns and critic).

Shapes: B sequences of T frames or rollouts, C context frames, H imagined steps, N slots, D slot width, K bins.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor
from torchrl.objectives.value.functional import td_lambda_return_estimate

from playslot_rl.baselines.sold.heads import ScalarHead
from playslot_rl.baselines.sold.imagination import Imagined


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


def reward_loss(head: ScalarHead, slots: Tensor, rewards: Tensor, valid: Tensor) -> Tensor:
    """Cross entropy of the rewards (B, T) received on the way to the frames of slots (B, T, N, D).

    No gradient runs into the slots.
    """
    return masked_mean(head.cross_entropy(head(slots.detach()), rewards), valid)


def discounts(gamma: float, horizon: int, like: Tensor) -> Tensor:
    """gamma^0 ... gamma^(H-1), (H,): how much an imagined step weighs."""
    return gamma ** torch.arange(horizon, device=like.device, dtype=like.dtype)


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
        imagined: the rollout.
        returns: R_0 ... R_{H-1} (B, H), differentiable in the actions for `dynamics`.
        baselines: v_0 ... v_{H-1} (B, H).
        scale: S, a number of at least 1.
        weights: w (H,).
        entropy: weight of the entropy.
        gradient: which estimator.
    """
    if gradient == "dynamics":
        objective = returns / scale
    else:
        objective = imagined.log_probs * ((returns - baselines) / scale).detach()
    return -(weights * (objective + entropy * imagined.entropies)).mean()


def value_loss(head: ScalarHead, logits: Tensor, returns: Tensor, slow: Tensor, weights: Tensor) -> Tensor:
    """Cross entropy of the returns and of what the slow critic says (DreamerV3): two targets of equal weight.

    Args:
        head: the critic, for its grid.
        logits: its logits (B, H, K).
        returns, slow: targets (B, H); no gradient runs into them.
        weights: w (H,).
    """
    return (weights * (head.cross_entropy(logits, returns) + head.cross_entropy(logits, slow))).mean()
