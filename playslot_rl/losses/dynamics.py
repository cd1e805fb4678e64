"""Stage 2: InvDyn and cOCVP on the slots of a frozen SAVi (paper, Eq. "full loss").

    L = lambda_img mean (o_t - o^_t)^2 + lambda_slot mean (S_t - S^_t)^2 + lambda_VQ L_VQ,   t = 2 .. T

Shapes: B batch, T frames (seed and predicted), N slots, D slot width, A action width, H W image height and width.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import LossModule

from playslot_rl import keys
from playslot_rl.config import DynamicsStageConfig
from playslot_rl.frames import normalise, psnr
from playslot_rl.losses.common import batch_psnr, draw_frames, of_frames
from playslot_rl.modules.inverse_dynamics import InverseDynamics, LatentActions
from playslot_rl.modules.predictors import Predictor
from playslot_rl.modules.quantizer import usage
from playslot_rl.modules.savi import SAVi


class DynamicsLoss(LossModule):
    """Image, slot and quantiser loss of one rollout.

    Reads SLOTS (B, T, N, D) as SAVi parsed them, PIXELS (B, T, 3, H, W) uint8 or float [0, 1], and in mode
    `ground_truth` ACTION (B, T or T-1, A). T is `seed_frames + predicted_frames` (any T above `seed_frames` is taken).
    Writes `loss_image`, `loss_slot` and `loss_vq`, **weights included**: their sum is what is minimised. To be logged:
    `mse_image`, `mse_slot` (no weights), `psnr` of the predicted frames (dB), `usage` (fraction of codes in the batch)
    and `perplexity` (1 to K).

    The rollout is autoregressive past the seed; every step counts, those inside the seed too, so that one seed frame
    does at inference. The image term back-propagates through the frozen decoder. With `decoded_frames` k > 0 it is
    taken on k of the T-1 predictions of each clip, drawn uniformly without replacement: an unbiased estimate.

    Note: `LossModule.forward` runs under deterministic exploration, which would turn samples into means. Nothing here
    depends on the exploration type: InvDyn samples z itself, in training mode, from `generator`.

    Args:
        inverse_dynamics, predictor: the models that are trained.
        savi: frozen here: put into evaluation mode, its parameters get no gradient.
        config: seed frames, decoded frames and weights.

    Examples:
        >>> from playslot_rl.testing import tiny_agent
        >>> model = tiny_agent().world_model
        >>> config = DynamicsStageConfig(seed_frames=1, predicted_frames=4, decoded_frames=2)
        >>> loss = DynamicsLoss(model.inverse_dynamics, model.predictor, model.savi, config)
        >>> pixels = torch.randint(256, (2, 5, 3, 64, 64), dtype=torch.uint8)
        >>> batch = TensorDict({"pixels": pixels, "slots": torch.randn(2, 5, 4, 32)}, [2])
        >>> out = loss(batch, generator=torch.Generator().manual_seed(0))
        >>> (out["loss_image"] + out["loss_slot"] + out["loss_vq"]).backward()
        >>> [key for key in out.keys() if not key.startswith("loss_")]
        ['mse_image', 'mse_slot', 'psnr', 'usage', 'perplexity']
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that `set_keys` can rename: parsed slots, the frames they were parsed from, and the real actions of mode
        `ground_truth`.
        """

        slots: NestedKey = keys.SLOTS
        pixels: NestedKey = keys.PIXELS
        action: NestedKey = keys.ACTION

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = ("loss_image", "loss_slot", "loss_vq", "mse_image", "mse_slot", "psnr", "usage", "perplexity")

    def __init__(
        self, inverse_dynamics: InverseDynamics, predictor: Predictor, savi: SAVi, config: DynamicsStageConfig
    ) -> None:
        super().__init__()
        self.inverse_dynamics = inverse_dynamics
        self.predictor = predictor
        self.savi = savi.eval().requires_grad_(False)
        self.config = config
        self.needs_actions = inverse_dynamics.config.mode == "ground_truth"

    def train(self, mode: bool = True) -> DynamicsLoss:
        """Training mode for the models that are trained; SAVi stays in evaluation mode."""
        super().train(mode)
        self.savi.eval()
        return self

    @property
    def in_keys(self) -> list[NestedKey]:
        names = self.tensor_keys
        return [names.slots, names.pixels, *([names.action] if self.needs_actions else [])]

    def forward(
        self, tensordict: TensorDictBase, generator: torch.Generator | None = None, teacher: bool = False
    ) -> TensorDictBase:
        """Infer latent actions, roll out, compare.

        Args:
            generator: draws z (in training mode) and the frames to decode.
            teacher: every input is a parsed slot and no prediction is fed back: one parallel pass.

        Raises:
            ValueError: no frame past the seed, or no actions in mode `ground_truth`.
        """
        slots = tensordict.get(self.tensor_keys.slots)
        seed = self.config.seed_frames
        if slots.shape[1] <= seed:
            raise ValueError(f"clip: got {slots.shape[1]} frames, expected more than dynamics.seed_frames={seed}")
        actions: Tensor | None = None
        if self.needs_actions:
            key = self.tensor_keys.action
            actions = tensordict.get(key, None)
            if actions is None:
                raise ValueError(f"mode ground_truth: got no {key!r}, expected (B, T, A); use a data set with actions")
            actions = actions[:, : slots.shape[1] - 1]
        latent = self.inverse_dynamics(slots, actions, generator)
        p, v = latent.prototype, latent.variability
        if teacher:
            predicted = self.predictor(slots[:, :-1], p, v)
        else:
            predicted = self.predictor.rollout(slots[:, :seed], p, v)
        mse_slot = (predicted - slots[:, 1:]).square().mean()
        mse_image, decibels = self._image(predicted, tensordict.get(self.tensor_keys.pixels)[:, 1:], generator)
        return self._collect(mse_image, decibels, mse_slot, latent)

    def _image(self, predicted: Tensor, pixels: Tensor, generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
        """Image error of predictions (B, T-1, N, D) against the frames (B, T-1, 3, H, W) that follow, and PSNR: in
        training that of the error, else the mean over every frame past the seed, clamped to [0, 1].
        """
        training, (batch, steps) = self.predictor.training, predicted.shape[:2]
        chosen = draw_frames(batch, steps, self.config.decoded_frames, generator) if training else None
        if chosen is not None:
            predicted, pixels = of_frames(predicted, chosen), of_frames(pixels, chosen)
        frames = normalise(pixels.to(predicted.device))
        decoded = self.savi.decode(predicted).frames
        mse = (decoded - frames).square().mean()
        if training:
            return mse, batch_psnr(mse)
        errors = (decoded.detach().clamp(0, 1) - frames).square().mean(dim=(2, 3, 4))
        return mse, psnr(errors[:, self.config.seed_frames - 1 :]).mean()

    def _collect(self, mse_image: Tensor, decibels: Tensor, mse_slot: Tensor, latent: LatentActions) -> TensorDict:
        config, k = self.config, max(self.inverse_dynamics.n_prototypes, 1)
        used, perplexity = usage(latent.code.detach(), k)
        return TensorDict(
            {
                "loss_image": config.image_weight * mse_image,
                "loss_slot": config.slot_weight * mse_slot,
                "loss_vq": config.vq_weight * latent.vq_loss,
                "mse_image": mse_image.detach(),
                "mse_slot": mse_slot.detach(),
                "psnr": decibels,
                "usage": used,
                "perplexity": perplexity,
            },
            [],
        )
