"""How much the actions seen in the generated frames say about those seen in the real ones.

    P = mean p p^T  (KxK),   P <- (P + P^T) / 2,   P <- decay P_old + (1 - decay) P
    I(P) = sum_kl P_kl log(P_kl / (P_k. P_.l))                            0 to log K, in nats

p are the probabilities of the actions on real frames, p^ those between the frames generated in their place. The
information is large where both say the same and all actions are used equally; it is added to the loss with a minus.

Shapes: K actions; `...` is any.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from playslot_rl.runtime.shares import all_rows

TINY = 1e-12


def joint_distribution(real: Tensor, generated: Tensor) -> Tensor:
    """Symmetric joint distribution (K, K) of probabilities (..., K), of the global batch; at least one row."""
    real, generated = all_rows(real.float().flatten(0, -2)), all_rows(generated.float().flatten(0, -2))
    joint = real.T @ generated / len(real)
    return (joint + joint.T) / 2


def mutual_information(joint: Tensor) -> Tensor:
    """Information (scalar, nats) between the two variables of a joint distribution (K, K) that sums to 1."""
    independent = joint.sum(dim=1, keepdim=True) * joint.sum(dim=0, keepdim=True)
    return (joint * (joint.clamp(min=TINY).log() - independent.clamp(min=TINY).log())).sum()


class ActionInformation(nn.Module):
    """The information of a moving average of the joint distribution, which starts with the first batch; gradients go
    through the newest part of it.
    """

    joint: Tensor
    updates: Tensor

    def __init__(self, actions: int, decay: float) -> None:
        super().__init__()
        self.decay = decay
        self.register_buffer("joint", torch.zeros(actions, actions))
        self.register_buffer("updates", torch.zeros((), dtype=torch.int64))

    def forward(self, real: Tensor, generated: Tensor) -> Tensor:
        """Information (scalar, nats) of probabilities (..., K); the average moves in training mode. With no rows it is
        0.
        """
        if real.numel() == 0:
            return real.new_zeros((), dtype=torch.float32)
        # A tensor, so that a GPU is not waited for.
        kept = self.decay * (self.updates > 0)
        joint = kept * self.joint + (1 - kept) * joint_distribution(real, generated)
        if self.training:
            with torch.no_grad():
                self.joint.copy_(joint)
                self.updates += 1
        return mutual_information(joint)
