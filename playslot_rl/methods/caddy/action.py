"""CADDY's action network A: what happened between two frames, as a direction, a discrete action and a variability.

    (mu_t, var_t) = A(s_t m_t)                                  where a frame is, B x Z
    d_t ~ N(mu_{t+1} - mu_t, var_{t+1} + var_t)                 how it moved
    p_t = softmax(Linear(d_t)),   a_t = softmax((log p_t + g) / tau)          g Gumbel noise, B x K
    c_k <- decay c_k + (1 - decay) sum p_tk d_t / sum p_tk      centroids, K x Z, no gradient
    v_t = sum_k a_tk (d_t - c_k)                                what the action does not say, B x Z

    KL(d_t, N(0, I)) = 1/2 sum_z (var + mean^2 - 1 - log var)

Variances are absolute values of what a linear layer gives, so they may be 0: 1e-6 is added before any root or log.
What the actions seen in the generated frames, p^, say about those seen in the real ones, p, is large where both say the
same and all actions are used equally; it is added to the loss with a minus:

    P = mean p p^T  (KxK),   P <- (P + P^T) / 2,   P <- decay P_old + (1 - decay) P
    I(P) = sum_kl P_kl log(P_kl / (P_k. P_.l))                            0 to log K, in nats

At test d_t is the mean and a_t the one-hot argmax of p_t.

Note: the original draws d and g at test too, and its centroids start anywhere; here nothing is drawn at test, and they
start at 0.

Shapes: B batch, T frames, C channels and h w size of a state, Z latent dim, K actions; `...` is any.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from playslot_rl.methods.caddy.networks import Res
from playslot_rl.runtime.shares import all_rows, own_noise

VARIANCE = 1e-6
"""Added to the variances."""
TINY = 1e-12


class Gaussian(NamedTuple):
    """Diagonal normal distributions: mean (..., Z), variances (..., Z), not negative."""

    mean: Tensor
    var: Tensor


class Moves(NamedTuple):
    """What happened between consecutive frames: the direction's distribution and d, drawn from it or its mean, each
    (B, T-1, Z), and logits (B, T-1, K) of p.
    """

    direction: Gaussian
    d: Tensor
    logits: Tensor

    @property
    def p(self) -> Tensor:
        return self.logits.softmax(dim=-1)


class Latents(NamedTuple):
    """What steers a prediction, one for each pair of consecutive frames: actions a (B, T-1, K), each a distribution
    (one-hot at test), variabilities v (B, T-1, Z), and the probabilities p that a was taken from (B, T-1, K).
    """

    a: Tensor
    v: Tensor
    p: Tensor


class Trunk(nn.Sequential):
    """Two residual blocks, the first of which halves, and the mean over the map that is left."""

    def __init__(self, in_channels: int, channels: int) -> None:
        super().__init__(Res(in_channels, channels, 2), Res(channels, channels))

    def forward(self, maps: Tensor) -> Tensor:
        """(B, C, h, w), h and w even, to (B, channels)."""
        for block in self:
            maps = block(maps)
        return maps.mean(dim=(-2, -1))


class ActionNetwork(nn.Module):
    """A, with the `decay` of the centroids' moving average."""

    centroids: Tensor

    def __init__(self, in_channels: int, channels: int, latent_dim: int, actions: int, decay: float) -> None:
        super().__init__()
        self.decay = decay
        self.trunk = Trunk(in_channels, channels)
        self.to_mean = nn.Linear(channels, latent_dim)
        self.to_var = nn.Linear(channels, latent_dim)
        self.to_logits = nn.Linear(latent_dim, actions)
        self.register_buffer("centroids", torch.zeros(actions, latent_dim))

    def pose(self, features: Tensor) -> Gaussian:
        """(mu, var) of frames, from their features s m (..., C, h, w) with h and w even: each (..., Z), float32."""
        flat = self.trunk(features.flatten(0, -4))
        mean, var = self.to_mean(flat), self.to_var(flat).abs()
        leading = features.shape[:-3]
        return Gaussian(mean.float().unflatten(0, leading), var.float().unflatten(0, leading))

    def moves(self, first: Gaussian, second: Gaussian, noise: torch.Generator | None = None) -> Moves:
        """The n moves between frames and those after them, each (B, n, Z); d is drawn with `noise`, or is the mean."""
        direction = difference(first, second)
        d = direction.mean
        if noise is not None:
            drawn = own_noise(d.shape, lambda shape: torch.randn(shape, generator=noise, device=noise.device))
            d = d + direction.var.sqrt() * _on(d, drawn)
        return Moves(direction, d, self.to_logits(d).float())

    def variability(self, a: Tensor, d: Tensor) -> Tensor:
        """v (..., Z) of actions (..., K) that sum to 1 and directions (..., Z)."""
        # A copy, because the centroids change in place before the gradient is taken.
        return d - a @ self.centroids.clone()

    @torch.no_grad()
    def update_centroids(self, p: Tensor, d: Tensor) -> None:
        """Move the centroids towards the p-weighted means of d over the global batch, (..., K) and (..., Z); in
        training mode only.
        """
        if not self.training:
            return
        p, d = all_rows(p.float().flatten(0, -2)), all_rows(d.float().flatten(0, -2))
        means = (p.T @ d) / p.sum(dim=0).clamp(min=1e-8)[:, None]
        self.centroids.lerp_(means, 1 - self.decay)


def difference(first: Gaussian, second: Gaussian) -> Gaussian:
    """Distribution of `second` minus `first`, both (..., Z) and independent; 1e-6 is added to its variance."""
    return Gaussian(second.mean - first.mean, second.var + first.var + VARIANCE)


def divergence(direction: Gaussian) -> Tensor:
    """KL(direction, N(0, I)) (...) in nats, summed over Z, for positive variances."""
    mean, var = direction
    return 0.5 * (var + mean.square() - 1 - var.log()).sum(dim=-1)


def gumbel_softmax(logits: Tensor, temperature: float, noise: torch.Generator) -> Tensor:
    """Soft samples (..., K), each summing to 1, of unnormalised log probabilities; towards temperature 0 they are
    one-hot.
    """
    drawn = own_noise(logits.shape, lambda shape: torch.rand(shape, generator=noise, device=noise.device))
    uniform = drawn.clamp(min=1e-20)
    gumbel = -(-uniform.log()).log()
    return ((logits + _on(logits, gumbel)) / temperature).softmax(dim=-1)


def chosen(p: Tensor) -> Tensor:
    """The most probable of the K actions as one-hot (..., K), float."""
    return F.one_hot(p.argmax(dim=-1), p.shape[-1]).to(p.dtype)


def _on(like: Tensor, drawn: Tensor) -> Tensor:
    return drawn.to(like.device)


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
