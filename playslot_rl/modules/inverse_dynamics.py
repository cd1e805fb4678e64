"""InvDyn: latent actions from consecutive slots (paper, section "InvDyn Module").

    mu_t, var_t = f(S_t);   z_t ~ N(mu_{t+1} - mu_t, var_{t+1} + var_t);   p_t = VQ(z_t),  v_t = z_t - sg[p_t]

Shapes: slots (B, T, N, D) -> z, p, v (B, T-1, Z) for InvDyn_S (one agent), (B, T-1, N, Z) for InvDyn_M (many).

Note: the paper's InvDyn_S sees all slots. With `config.slots` f sees some of them, so that z says nothing of what moves
by itself in the others (after Klepach et al., Object-Centric Latent Action Learning, 2025, who choose slots, too).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from playslot_rl.config import InverseDynamicsConfig
from playslot_rl.modules.action_range import ActionRange
from playslot_rl.modules.quantizer import ActionQuantizer
from playslot_rl.modules.transformer import SlotTokenEncoder, chosen_slots
from playslot_rl.runtime.precision import full_precision
from playslot_rl.runtime.shares import own_noise


class LatentActions(NamedTuple):
    """Latent actions between consecutive frames.

    z (sampled in training), its mean, prototype p and variability v: (B, T-1, [N,] Z); code: int64 (B, T-1, [N]);
    vq_loss: scalar.
    """

    z: Tensor
    mean: Tensor
    prototype: Tensor
    variability: Tensor
    code: Tensor
    vq_loss: Tensor


class SlotMLP(nn.Module):
    """InvDyn_M's two-layer MLP with ReLU and layer norm, shared by all slots: (..., N, D) -> (..., N, dim)."""

    def __init__(self, slot_dim: int, dim: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.LayerNorm(slot_dim), nn.Linear(slot_dim, dim), nn.ReLU(), nn.Linear(dim, dim), nn.LayerNorm(dim)
        )

    def forward(self, slots: Tensor) -> Tensor:
        """Slots (..., N, D) to (..., N, dim)."""
        out: Tensor = self.layers(slots)
        return out


class InverseDynamics(nn.Module):
    """InvDyn_S or InvDyn_M, by `config.variant`.

    Note: the paper does not say where var starts. Here it is softplus(-4) = 0.018, with a tenth of the usual weights: a
    softplus of 0 would drown the differences of neighbouring frames.

    Args:
        config: sizes and mode; in mode `none` latents have width 0, and say only how many frames there are.
        action_dim: A, the width of z in mode `ground_truth`.

    Example:
        >>> model = InverseDynamics(InverseDynamicsConfig(), slot_dim=128, action_dim=4).eval()
        >>> model(torch.randn(2, 5, 4, 128)).z.shape
        torch.Size([2, 4, 16])
    """

    def __init__(self, config: InverseDynamicsConfig, slot_dim: int, action_dim: int) -> None:
        super().__init__()
        self.config = config
        self.per_slot = config.variant == "multi"
        self.latent_dim = {"ground_truth": action_dim, "none": 0}.get(config.mode, config.latent_dim)
        if config.mode in ("ground_truth", "none") and self.per_slot:
            raise ValueError(
                f"mode {config.mode} with variant multi: real actions are not per slot; use variant=single"
            )
        c = config
        if config.mode not in ("ground_truth", "none"):
            self.encoder: nn.Module = (
                SlotMLP(slot_dim, c.dim)
                if self.per_slot
                else SlotTokenEncoder(slot_dim, c.dim, c.layers, c.heads, c.head_dim, c.mlp_dim)
            )
            self.to_mean = nn.Linear(c.dim, c.latent_dim)
            self.to_variance = nn.Linear(c.dim, c.latent_dim)
            nn.init.constant_(self.to_variance.bias, -4.0)
            with torch.no_grad():
                self.to_variance.weight.mul_(0.1)
        if config.mode == "ground_truth":
            self.action_range = ActionRange(action_dim)
        if config.mode in ("hybrid", "discrete"):
            self.quantizer = ActionQuantizer(c.latent_dim, c.n_prototypes, c.decay, c.dead_threshold, c.commitment)

    @property
    def n_prototypes(self) -> int:
        """K, or 0 in the modes without prototypes."""
        return self.config.n_prototypes if hasattr(self, "quantizer") else 0

    @property
    def prototypes(self) -> Tensor:
        """The codebook (K, Z); raises ValueError in the modes without one."""
        if not hasattr(self, "quantizer"):
            raise ValueError(f"mode {self.config.mode} has no prototypes; use mode hybrid or discrete")
        return self.quantizer.prototypes

    def scene_dynamics(self, slots: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and variance of the scene dynamics of each frame: slots (..., N, D) -> two of (..., [N,] Z)."""
        h = self.encoder(chosen_slots(slots, self.config.slots))
        with full_precision(slots.device.type):  # z is a difference of two means that are nearly equal
            h = h.to(slots.dtype)
            return self.to_mean(h), F.softplus(self.to_variance(h)) + 1e-6

    def forward(
        self, slots: Tensor, actions: Tensor | None = None, generator: torch.Generator | None = None
    ) -> LatentActions:
        """Infer the latent actions of a clip (B, T, N, D).

        Args:
            actions: real actions (B, T-1, A) in the robot's units, needed in mode `ground_truth` only; z are these in
                [-1, 1] (`action_range`), and beyond it where they are beyond the range.
            generator: draws z in training, and at evaluation with `config.sample`.

        Raises:
            ValueError: mode `ground_truth` without actions.
        """
        if self.config.mode == "ground_truth":
            if actions is None:
                raise ValueError("mode ground_truth: got no actions, expected (B, T-1, A); use a data set with actions")
            z = self.action_range.to_unit(actions)
            return self._compose(z, z)
        if self.config.mode == "none":
            nothing = slots.new_zeros(len(slots), slots.shape[1] - 1, 0)
            return self._compose(nothing, nothing)
        mu, var = self.scene_dynamics(slots)
        mean, variance = mu[:, 1:] - mu[:, :-1], var[:, 1:] + var[:, :-1]
        z = mean
        if self.training or self.config.sample:
            device, dtype = mean.device, mean.dtype  # the draw may be kept, and is not to keep the mean
            noise = own_noise(mean.shape, lambda s: torch.randn(s, generator=generator, device=device, dtype=dtype))
            z = mean + variance.sqrt() * noise
        return self._compose(z, mean)

    def split(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Prototype and variability of given latents z (..., Z), as cOCVP takes them."""
        out = self._compose(z, z)
        return out.prototype, out.variability

    def _compose(self, z: Tensor, mean: Tensor) -> LatentActions:
        mode = self.config.mode
        if mode in ("continuous", "ground_truth", "none"):
            # Without a codebook z enters through the variability's projection alone.
            code = torch.zeros(z.shape[:-1], dtype=torch.long, device=z.device)
            return LatentActions(z, mean, torch.zeros_like(z), z, code, z.new_zeros(()))
        with full_precision(z.device.type):
            p, code, loss = self.quantizer(z)
        v = z - p.detach() if mode == "hybrid" else torch.zeros_like(z)
        return LatentActions(z, mean, p, v, code, loss)
