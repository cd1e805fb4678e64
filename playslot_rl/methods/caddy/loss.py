"""CADDY's loss.

    L = mean_r [L1_r + lambda_perc L_perc_r] + lambda_s mean (sg[s_t] - E(x^_t))^2 + lambda_KL mean KL(d_t, N(0, I))
        - lambda_I I(P)  [+ mean (sg[conv(s_t)] - y_t)^2 in the warm-up]

r runs over the three resolutions, to which the real frames are brought by averaging. Pixels are compared in [-1, 1].
Image and state terms are means over the frames that are `wanted`: for wanted ones that were drawn uniformly, unbiased
estimates of those over all of them. The divergence is summed over Z and averaged over moves. Without VGG19's weights
there is no L_perc: L1 only.

Note: in the warm-up the other terms stay, on the reconstructions in place of the predictions.

Shapes: B batch, T frames, n frames that were generated, H W image height and width.
"""

from __future__ import annotations

from collections.abc import Collection

import torch
from torch import Tensor
from torch.nn import functional as F

from playslot_rl.losses.common import total_loss
from playslot_rl.methods.caddy.action import ActionInformation, divergence
from playslot_rl.methods.caddy.config import CADDYConfig
from playslot_rl.methods.caddy.model import Rollout
from playslot_rl.methods.caddy.perceptual import VGGFeatures


class CADDYLoss:
    """All terms, with their weights; without `perceptual` images are compared by L1 only."""

    def __init__(self, config: CADDYConfig, perceptual: VGGFeatures | None = None) -> None:
        self.config, self.perceptual = config, perceptual

    @property
    def perceptual_on(self) -> bool:
        return self.perceptual is not None

    def __call__(
        self, rollout: Rollout, frames: Tensor, information: ActionInformation, wanted: Collection[int] | None = None
    ) -> dict[str, Tensor]:
        """Terms `loss_*`, weights included, their sum `loss`, and `information` (nats, no weight): scalars.

        Args:
            rollout: of the clips.
            frames: the clips (B, T, 3, H, W), float [0, 1].
            information: its moving average moves in training mode.
            wanted: times of generated frames that image and state are compared at; None: all.
        """
        config, generated = self.config, rollout.generated
        places = [i for i, time in enumerate(generated.times) if wanted is None or time in wanted]
        times = [generated.times[i] for i in places]
        known = information(rollout.real, rollout.again)
        terms = self._images([x[:, places] for x in generated.frames], frames[:, times] * 2 - 1)
        terms["loss_state"] = config.state_weight * F.mse_loss(generated.s[:, places], rollout.s[:, times].detach())
        terms["loss_kl"] = config.kl_weight * divergence(rollout.moves.direction).mean()
        terms["loss_information"] = -config.information_weight * known
        if rollout.codes is not None:
            terms["loss_fit"] = F.mse_loss(generated.y.float(), rollout.codes.detach().float())
        return {"loss": total_loss(terms), **terms, "information": known.detach()}

    def _images(self, pyramid: list[Tensor], target: Tensor) -> dict[str, Tensor]:
        """Terms of frames at three resolutions, each (B, n, 3, h, w), against (B, n, 3, H, W), all in [-1, 1]."""
        target = target.flatten(0, 1)
        errors, distances = [], []
        for level in pyramid:
            wanted = F.avg_pool2d(target, target.shape[-1] // level.shape[-1])
            errors.append((level.flatten(0, 1) - wanted).abs().mean())
            if self.perceptual is not None:
                distances.append(self.perceptual.distance(level.flatten(0, 1), wanted))
        terms = {"loss_image": torch.stack(errors).mean()}
        if distances:
            terms["loss_perceptual"] = self.config.perceptual_weight * torch.stack(distances).mean()
        return terms
