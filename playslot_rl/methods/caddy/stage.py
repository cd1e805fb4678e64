"""Training of CADDY on unlabelled videos: a `Stage` for `fit`.

Warm-up, temperature and the clips' length are functions of the step alone:

    warm-up       while step < warmup_steps
    temperature   from the first value to the second, linearly over anneal_steps
    length        from first_frames to S + predicted, linearly over growth_steps, rounded down

Note: the original decays weights by 1e-6; our Adam does not. Counts of steps are those of the original, warm-up
included.

Shapes: B batch, T frames, S seed frames, K actions.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from playslot_rl.data.windows import Clips, IntArray
from playslot_rl.frames import normalise, psnr
from playslot_rl.methods.caddy.action import joint_distribution, mutual_information
from playslot_rl.methods.caddy.config import CADDYConfig
from playslot_rl.methods.caddy.loss import CADDYLoss
from playslot_rl.methods.caddy.model import CADDY
from playslot_rl.methods.caddy.perceptual import load_perceptual
from playslot_rl.modules.quantizer import usage
from playslot_rl.runtime.precision import autocast
from playslot_rl.runtime.processes import spread
from playslot_rl.runtime.shares import own_rows
from playslot_rl.seeds.draws import StepGenerators
from playslot_rl.world_model import module_device


class CADDYStage:
    """CADDY, trained in place on clips of S + predicted frames; VGG19's weights that cannot be read are a
    CheckpointError.
    """

    def __init__(self, model: CADDY, clips: Clips, config: CADDYConfig) -> None:
        self.model, self.clips, self.config = model, clips, config
        perceptual = load_perceptual(config.perceptual)
        self.objective = CADDYLoss(config, None if perceptual is None else perceptual.to(module_device(model)))

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        return {"caddy": self.model}

    @property
    def perceptual_on(self) -> bool:
        return self.objective.perceptual_on

    def loss(self, step: int, generators: StepGenerators) -> Mapping[str, Tensor]:
        config = self.config
        rows = own_rows(self.clips.sample(config.batch_size, generators.numpy("clips")))
        frames = self._frames(rows[:, : clip_length(config, step)])
        wanted = self._wanted(frames.shape[1], generators)
        with autocast(frames.device.type, config.precision):
            rollout = self.model(
                frames,
                config.seed_frames,
                temperature(config, step),
                generators.torch("noise", frames.device),
                wanted,
                warmup=step < config.warmup_steps,
            )
        terms = self.objective(rollout, frames, self.model.information, wanted)
        used, perplexity = usage(rollout.moves.logits.detach().argmax(dim=-1), config.actions)
        return {**terms, "usage": used, "perplexity": perplexity}

    def validate(self, step: int) -> Mapping[str, float]:  # noqa: ARG002
        """Numbers of held-out clips, past their seed.

        `psnr` (dB, mean over frames) and `mse` of the predicted frames, clamped to [0, 1]; `usage` and `perplexity`
        (1 to K) of the actions; `information` (nats, 0 to log K) between them and those in the predicted frames;
        `variability`, the part that v has in the mean square of d.
        """
        looked = spread(self.clips.validation_batches(), lambda _, rows: self._look(rows))
        errors, real, again, parts = zip(*looked, strict=True)
        squares = torch.zeros(2)
        for part in parts:
            squares += part
        error, p = torch.cat(errors), torch.cat(real)
        used, perplexity = usage(p.argmax(dim=-1), self.config.actions)
        return {
            "psnr": float(psnr(error).mean()),
            "mse": float(error.mean()),
            "usage": float(used),
            "perplexity": float(perplexity),
            "information": float(mutual_information(joint_distribution(p, torch.cat(again)))),
            "variability": float(squares[0] / squares[1].clamp(min=1e-12)),
        }

    def _look(self, rows: IntArray) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Errors of the frames, probabilities of actions in real and predicted ones, and squares of v and d."""
        frames, seed = self._frames(rows), self.config.seed_frames
        predicted = self.model.predict(frames, seed)
        error = (predicted.clamp(0, 1) - frames[:, seed:]).square().mean(dim=(2, 3, 4)).flatten()
        latents = self.model.infer(frames[:, seed - 1 :])
        again = self.model.infer(torch.cat((frames[:, seed - 1 : seed], predicted), dim=1)).p.flatten(0, 1)
        d = latents.v + latents.a @ self.model.action.centroids
        squares = torch.stack((latents.v.square().sum(), d.square().sum())).cpu()
        return error, latents.p.flatten(0, 1), again, squares

    def _frames(self, rows: IntArray) -> Tensor:
        return normalise(self.clips.source.pixels(rows).to(module_device(self.model)))

    def _wanted(self, frames: int, generators: StepGenerators) -> list[int] | None:
        """Times of the frames that are compared: `decoded_frames` of those after the first, the same in all clips."""
        count = self.config.decoded_frames
        if not 0 < count < frames - 1:
            return None
        drawn = generators.numpy("decoded").choice(frames - 1, size=count, replace=False)
        return sorted(1 + int(time) for time in drawn)


def temperature(config: CADDYConfig, step: int) -> float:
    first, last = config.temperature
    return first + (last - first) * min(1.0, step / config.anneal_steps)


def clip_length(config: CADDYConfig, step: int) -> int:
    """Frames of a clip at a step, from 0."""
    last = config.seed_frames + config.predicted_frames
    first = min(config.first_frames, last)
    if step >= config.growth_steps:
        return last
    return first + (last - first) * step // config.growth_steps
