"""Stage 1: SAVi on unlabelled clips (paper, appendix A.1). A `Stage` for `playslot_rl.training.fit`."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from playslot_rl import keys
from playslot_rl.config import SlotsStageConfig
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.windows import Clips, IntArray
from playslot_rl.losses.slots import SlotsLoss
from playslot_rl.modules.savi import SAVi
from playslot_rl.seeding import StepGenerators, step_generator


class SlotsStage:
    """Reconstruct clips from slots.

    Args:
        savi: trained in place.
        source: unlabelled videos.
        config: clip length, batch, precision.
        validation: fraction of episodes held out.
        seed: of the split.
        device: where `savi` is.
    """

    def __init__(
        self,
        savi: SAVi,
        source: EpisodeFrames,
        config: SlotsStageConfig,
        *,
        validation: float,
        seed: int,
        device: torch.device | str = "cpu",
    ) -> None:
        self.savi, self.source, self.config, self.device = savi, source, config, device
        self.criterion = SlotsLoss(savi)
        self.clips = Clips(source, config.clip_frames, validation, seed)

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        """SAVi."""
        return {"savi": self.savi}

    def loss(self, step: int, generators: StepGenerators) -> Mapping[str, Tensor]:  # noqa: ARG002
        """Reconstruction error of one batch of clips."""
        rows = self.clips.sample(self.config.batch_size, generators.numpy("windows"))
        self.savi.precision = self.config.precision
        out = self.criterion(self._batch(rows), generator=generators.torch("slots"))
        return {"loss": out["loss_reconstruction"], "psnr": out["psnr"]}

    def validate(self, step: int) -> Mapping[str, float]:
        """PSNR (dB) on held-out clips, in fp32."""
        self.savi.precision = "fp32"
        errors = []
        for rows in self.clips.validation_batches():
            out = self.criterion(self._batch(rows), generator=step_generator(0, step, "validation", self.device))
            errors.append(float(out["loss_reconstruction"]))
        mse = float(np.mean(errors))
        return {"mse": mse, "psnr": -10.0 * float(np.log10(max(mse, 1e-12)))}

    def _batch(self, rows: IntArray) -> TensorDict:
        return TensorDict({keys.PIXELS: self.source.pixels(rows).to(self.device)}, [len(rows)])
