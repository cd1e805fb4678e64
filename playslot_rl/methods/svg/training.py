"""Training of SVG-LP on unlabelled videos, by a lower bound on the likelihood of a clip (Denton and Fergus, 2018,
section 3), and a trained one from disk.

    L = sum_{t=2}^T  mean (x^_t - x_t)^2 + beta KL(q_t || p_t)
    KL = 1/2 sum_z [ log s_p^2 / s_q^2 + (s_q^2 + (m_q - m_p)^2) / s_p^2 - 1 ]

Means are over batch, pixels and colours, the divergence is summed over Z; s^2 are variances, m means.

Shapes: B batch, T frames of a clip (seed and predicted), S seed frames, H W image height and width, Z latent, k decoded
steps.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from playslot_rl import keys
from playslot_rl.config import EnvConfig
from playslot_rl.data.clips import Clips
from playslot_rl.data.views import IntArray
from playslot_rl.frames import normalise, psnr
from playslot_rl.losses.common import draw_frames, of_frames
from playslot_rl.methods.svg.method import SVGConfig
from playslot_rl.methods.svg.model import SVG, Gaussian, TeacherForced
from playslot_rl.methods.video.training import pixel_model
from playslot_rl.runs import Run
from playslot_rl.runtime.precision import autocast
from playslot_rl.runtime.processes import spread
from playslot_rl.seeds.draws import StepGenerators, step_generator
from playslot_rl.training.record import StageRecord
from playslot_rl.training.run_stage import Training, on_clips
from playslot_rl.world_model import module_device


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


class SVGStage:
    def __init__(self, model: SVG, clips: Clips, config: SVGConfig) -> None:
        self.model, self.clips, self.config = model, clips, config

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        return {"svg": self.model}

    def batch(self, step: int, generators: StepGenerators) -> Mapping[str, Tensor]:  # noqa: ARG002
        return {keys.PIXELS: self.clips.batch("clips", self.config.batch_size, generators, module_device(self.model))}

    def loss(self, batch: Mapping[str, Tensor], step: int, generators: StepGenerators) -> Mapping[str, Tensor]:  # noqa: ARG002
        config, frames = self.config, normalise(batch[keys.PIXELS])
        device, (count, length) = frames.device, frames.shape[:2]
        steps = draw_frames(count, length - 1, config.decoded_frames, generators.torch("decoded", device))
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
        return normalise(self.clips.pixels(rows, module_device(self.model)))


def _errors(predicted: Tensor, frames: Tensor) -> Tensor:
    """Mean squared error of each predicted frame (B, T - S), against the last ones of the clips."""
    target = frames[:, -predicted.shape[1] :]
    return (predicted.clamp(0, 1) - target).square().mean(dim=(-3, -2, -1))


def training(record: StageRecord) -> Training:
    own: SVGConfig = record.config.baselines.svg
    return on_clips(record, SVGStage(pixel_model(SVG, own, record), record.clips(own.frames), own), own)


def load_video(run: Run, device: torch.device | str = "cpu") -> SVG:
    """The model of a finished run; a CheckpointError where it is missing or damaged."""
    done = run.stage("svg")
    own, size = done.group(SVGConfig, "svg"), done.group(EnvConfig, "env").image_size
    return done.restore(lambda: SVG(own, size), "svg", device)
