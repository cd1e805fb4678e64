"""SVG's objective, a lower bound on the likelihood of a clip (Denton and Fergus, 2018, section 3).

    L = sum_{t=2}^T  mean (x^_t - x_t)^2 + beta KL(q_t || p_t)
    KL = 1/2 sum_z [ log s_p^2 / s_q^2 + (s_q^2 + (m_q - m_p)^2) / s_p^2 - 1 ]

Means are over batch, pixels and colours, the divergence is summed over Z; s^2 are variances, m means.

Shapes: B batch, T frames of a clip, H W image height and width, Z latent, k decoded steps.
"""

from __future__ import annotations

from torch import Tensor

from playslot_rl.frames import normalise
from playslot_rl.losses.common import of_frames
from playslot_rl.methods.svg.model import TeacherForced
from playslot_rl.methods.svg.networks import Gaussian


def gaussian_kl(posterior: Gaussian, prior: Gaussian) -> Tensor:
    """KL(posterior || prior) of diagonal Gaussians (..., Z), summed over Z: (...) in nats, at least 0."""
    spread = posterior.log_variance - prior.log_variance
    distance = (posterior.mean - prior.mean).square() * (-prior.log_variance).exp()
    return 0.5 * (spread.exp() + distance - 1 - spread).sum(dim=-1)


def svg_objective(out: TeacherForced, frames: Tensor, kl_weight: float) -> dict[str, Tensor]:
    """Loss of a pass over true clips (B, T, 3, H, W), uint8 or float [0, 1].

    With k of T - 1 predictions decoded, the image term is (T - 1) / k times their sum: an unbiased estimate, as far as
    the prediction of a frame does not depend on which others are decoded (in training mode it does, through
    BatchNorm).

    Returns:
        Scalars: `loss`, the sum of `loss_image` and `loss_kl` (beta included), which are sums over steps; to be logged,
        `mse` of a predicted frame and `kl` of a step in nats, without beta.
    """
    steps = frames.shape[1] - 1
    target = normalise(of_frames(frames, out.steps + 1))
    mse = (out.predicted - target).square().mean()
    kl = gaussian_kl(out.posterior, out.prior).mean()
    image, divergence = steps * mse, kl_weight * steps * kl
    return {
        "loss": image + divergence,
        "loss_image": image,
        "loss_kl": divergence,
        "mse": mse.detach(),
        "kl": kl.detach(),
    }
