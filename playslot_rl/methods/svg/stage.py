"""Training of SVG-LP on unlabelled videos: a `Stage` for `fit`.

Shapes: B batch, T frames (seed and predicted), S seed frames, H W image height and width.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from playslot_rl.data.windows import Clips, IntArray
from playslot_rl.frames import normalise, psnr
from playslot_rl.losses.common import draw_frames
from playslot_rl.methods.svg.config import SVGConfig
from playslot_rl.methods.svg.loss import gaussian_kl, svg_objective
from playslot_rl.methods.svg.model import SVG
from playslot_rl.runtime.precision import autocast
from playslot_rl.runtime.processes import spread
from playslot_rl.runtime.shares import own_rows
from playslot_rl.seeds.draws import StepGenerators, step_generator
from playslot_rl.world_model import module_device


class SVGStage:
    """All of SVG-LP at once, on clips of T frames."""

    def __init__(self, model: SVG, clips: Clips, config: SVGConfig) -> None:
        self.model, self.clips, self.config = model, clips, config

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        return {"svg": self.model}

    def loss(self, step: int, generators: StepGenerators) -> Mapping[str, Tensor]:  # noqa: ARG002
        config = self.config
        frames = self._frames(own_rows(self.clips.sample(config.batch_size, generators.numpy("clips"))))
        device = frames.device
        batch, count = frames.shape[:2]
        steps = draw_frames(batch, count - 1, config.decoded_frames, generators.torch("decoded", device))
        with autocast(device.type, config.precision):
            out = self.model(frames, config.seed_frames, generators.torch("latents", device), steps)
        return svg_objective(out, frames, config.kl_weight)

    def validate(self, step: int) -> Mapping[str, float]:  # noqa: ARG002
        """Errors of the held-out clips' predicted frames, fed back past the seed.

        Returns:
            `psnr` (dB, mean over frames) and `mse` with latents from the true future; `psnr_prior` with latents that
            the prior draws: close to `psnr` where the latents are ignored; `kl`, nats a step on true frames.
        """

        def look(number: int, rows: IntArray) -> tuple[Tensor, Tensor, Tensor]:
            frames, seed = self._frames(rows), self.config.seed_frames
            generator = step_generator(0, number, "validation", frames.device)
            inferred = _errors(self.model.predict(frames, seed), frames)
            drawn = _errors(self.model.sample(frames, seed, generator), frames)
            return inferred, drawn, gaussian_kl(*self.model.distributions(self.model.encode(frames)))

        inferred, drawn, divergence = zip(*spread(self.clips.validation_batches(), look), strict=True)
        mse = torch.cat(inferred)
        return {
            "psnr": float(psnr(mse).mean()),
            "mse": float(mse.mean()),
            "psnr_prior": float(psnr(torch.cat(drawn)).mean()),
            "kl": float(torch.cat(divergence).mean()),
        }

    def _frames(self, rows: IntArray) -> Tensor:
        return normalise(self.clips.source.pixels(rows).to(module_device(self.model)))


def _errors(predicted: Tensor, frames: Tensor) -> Tensor:
    """Mean squared error of each predicted frame (B, T - S), against the last ones of the clips."""
    target = frames[:, -predicted.shape[1] :]
    return (predicted.clamp(0, 1) - target).square().mean(dim=(-3, -2, -1))
