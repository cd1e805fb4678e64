"""Lambda returns of imagined trajectories.

Shapes: B trajectories, H steps; step t leads from state t to state t + 1.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torchrl.objectives.value.functional import td_lambda_return_estimate


def lambda_returns(rewards: Tensor, values: Tensor, gamma: float, lmbda: float) -> Tensor:
    """R_t = r_{t+1} + gamma ((1 - lambda) v_{t+1} + lambda R_{t+1}), with R_H = v_H (DreamerV3, Eq. "lambda return").

    Imagined trajectories never end, so there is no continuation flag.

    Args:
        rewards: r_1 ... r_H, (..., H, 1): of arriving at the next state.
        values: v_1 ... v_H, (..., H, 1): of the next state.
        gamma, lmbda: in [0, 1].

    Returns:
        R_0 ... R_{H-1}, (..., H, 1).

    Examples:
        >>> lambda_returns(torch.ones(2, 1), torch.zeros(2, 1), 0.5, 1.0).squeeze(-1).tolist()
        [1.5, 1.0]
    """
    over = torch.zeros(rewards.shape, dtype=torch.bool, device=rewards.device)
    returns: Tensor = td_lambda_return_estimate(gamma, lmbda, values, rewards, done=over, terminated=over)
    return returns
