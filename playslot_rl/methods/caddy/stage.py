"""Training of CADDY on unlabelled videos: a `Stage` for `fit`, and its loss.

    L = mean_r [L1_r + lambda_perc L_perc_r] + lambda_s mean (sg[s_t] - E(x^_t))^2 + lambda_KL mean KL(d_t, N(0, I))
        - lambda_I I(P)  [+ mean (sg[conv(s_t)] - y_t)^2 in the warm-up]

r runs over the three resolutions, to which the real frames are brought by averaging. Pixels are compared in [-1, 1].
Image and state terms are means over the frames that are `wanted`: for wanted ones that were drawn uniformly, unbiased
estimates of those over all of them. The divergence is summed over Z and averaged over moves. Without VGG19's weights
there is no L_perc: L1 only. No package ships them.

    L_perc(x^, x) = sum_l mean |phi_l(x^) - phi_l(x)|,   l over the first ReLU of each of VGG19's five resolutions

Warm-up, temperature and the clips' length are functions of the step alone:

    warm-up       while step < warmup_steps
    temperature   from the first value to the second, linearly over anneal_steps
    length        from first_frames to S + predicted, linearly over growth_steps, rounded down

Note: which five ReLUs the original takes is not stated; the first of each resolution is the common choice (Johnson et
al., 2016). A frame that is too small for the last ones has fewer.

Note: in the warm-up the other terms stay, on the reconstructions in place of the predictions. The original decays
weights by 1e-6; our Adam does not. Counts of steps are those of the original, warm-up included.

Shapes: B batch, T frames, S seed frames, n frames that were generated, H W image height and width, K actions.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from playslot_rl import keys
from playslot_rl.data.clips import Clips
from playslot_rl.data.views import IntArray
from playslot_rl.frames import IMAGENET_MEAN, IMAGENET_STD, normalise, psnr
from playslot_rl.losses.common import total_loss
from playslot_rl.methods.caddy.action import ActionInformation, divergence, joint_distribution, mutual_information
from playslot_rl.methods.caddy.method import CADDYConfig
from playslot_rl.methods.caddy.model import CADDY, Rollout, at_times
from playslot_rl.modules.quantizer import usage
from playslot_rl.runtime.precision import autocast
from playslot_rl.runtime.processes import spread
from playslot_rl.seeds.draws import StepGenerators
from playslot_rl.storage.tensors import cached, load_published
from playslot_rl.world_model import module_device

KEY = "baselines.caddy.perceptual"

# Places of the ReLUs among the layers.
_READ = (1, 6, 11, 20, 29)


class VGGFeatures(nn.Module):
    """VGG19 up to the last layer that is read, frozen; layers are named as torchvision names them."""

    mean: Tensor
    std: Tensor

    def __init__(self) -> None:
        from torchvision.models.vgg import cfgs, make_layers

        super().__init__()
        self.features = make_layers(cfgs["E"])[: _READ[-1] + 1]
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD).view(3, 1, 1), persistent=False)
        self.requires_grad_(False)
        self.eval()

    def forward(self, x: Tensor) -> list[Tensor]:
        """Frames (B, 3, H, W) in [-1, 1] to the outputs of the ReLUs that are read, as many as the size allows."""
        x = ((x + 1) / 2 - self.mean) / self.std
        outputs = []
        for place, layer in enumerate(self.features):
            if isinstance(layer, nn.MaxPool2d) and min(x.shape[-2:]) < 2:
                break
            x = layer(x)
            if place in _READ:
                outputs.append(x)
        return outputs

    def distance(self, predicted: Tensor, target: Tensor) -> Tensor:
        """L_perc (scalar) of frames (B, 3, H, W) in [-1, 1]; no gradient goes to the target."""
        with torch.no_grad():
            wanted = self(target)
        levels = [(a - b).float().abs().mean() for a, b in zip(self(predicted), wanted, strict=True)]
        return torch.stack(levels).sum()


def load_perceptual(weights: str) -> VGGFeatures | None:
    """VGG19's features on the CPU, frozen, for `CADDYConfig.perceptual`; None where it is empty, or `auto` and torch's
    cache does not have the weights; a CheckpointError where the file is missing, damaged or not VGG19's.
    """
    if not weights:
        return None
    from torchvision.models import VGG19_Weights

    path = cached(VGG19_Weights.IMAGENET1K_V1.url) if weights == "auto" else Path(weights)
    if weights == "auto" and not path.is_file():
        return None
    with torch.random.fork_rng(devices=[]):
        network = VGGFeatures()
    load_published(network, path, KEY, "VGG19", ("give torchvision's VGG19", "leave it empty"))
    return network


class CADDYLoss:
    """All terms, with their weights; without `perceptual` images are compared by L1 only."""

    def __init__(self, config: CADDYConfig, perceptual: VGGFeatures | None = None) -> None:
        self.config, self.perceptual = config, perceptual

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
        terms = self._images([at_times(x, places) for x in generated.frames], at_times(frames, times) * 2 - 1)
        state, true_state = at_times(generated.s, places), at_times(rollout.s, times).detach()
        terms["loss_state"] = config.state_weight * F.mse_loss(state, true_state)
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

    def phase(self, step: int) -> str | None:
        """None while temperature or length change, or where the frames that are compared are drawn."""
        config = self.config
        changes = config.temperature[0] != config.temperature[1] and step < config.anneal_steps
        if changes or clip_length(config, step) < clip_length(config, config.growth_steps) or config.decoded_frames:
            return None
        return "warm-up" if step < config.warmup_steps else "all"

    def batch(self, step: int, generators: StepGenerators) -> Mapping[str, Tensor]:
        config, device = self.config, module_device(self.model)
        frames = clip_length(config, step)
        return {keys.PIXELS: self.clips.batch("clips", config.batch_size, generators, device, frames)}

    def loss(self, batch: Mapping[str, Tensor], step: int, generators: StepGenerators) -> Mapping[str, Tensor]:
        config, frames = self.config, normalise(batch[keys.PIXELS])
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
        return normalise(self.clips.pixels(rows, module_device(self.model)))

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
