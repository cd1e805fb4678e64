"""Trainings of LAPO: inverse and forward model on unlabelled videos; then a latent policy that clones the inverse
model's latents, and an action decoder.

    L = mean (o^_{t+1} - o_{t+1})^2 / mean (o_t - o_{t+1})^2 + L_VQ
    L_pi = mean (pi(o_t) - z_t)^2,   L_a = mean (D(z_t) - a_t)^2

Note: LAPO has the plain mean squared error. Most pixels of a scene stand still, so its scale says little; divided by
the error of predicting no change (a constant of the data set) it is 1 before training, whatever the task, and
`unexplained` is the fraction of the change that is not predicted. LAPO fine-tunes its policy online or fits a decoder
on labelled transitions; this is the second.

Shapes: B batch, H W image height and width, M transitions, Z latent-action width.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Final, Literal

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from playslot_rl import keys
from playslot_rl.config import StageConfig
from playslot_rl.data.clips import Clips
from playslot_rl.data.demonstrations import Transitions
from playslot_rl.data.device_rows import DeviceRows
from playslot_rl.data.neighbours import Ends, in_batches
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.views import IntArray
from playslot_rl.errors import CheckpointError
from playslot_rl.frames import normalise
from playslot_rl.methods.cloning import LatentCloning, cloning, inferred
from playslot_rl.methods.lapo.method import NAME, LAPOConfig
from playslot_rl.methods.lapo.model import ForwardModel, InverseModel, LAPOPolicy, QuantisedInverse
from playslot_rl.modules.quantizer import usage
from playslot_rl.runtime.precision import autocast
from playslot_rl.runtime.processes import spread
from playslot_rl.runtime.shares import own_rows
from playslot_rl.seeds.draws import StepGenerators, global_seed
from playslot_rl.storage.checkpoints import StageCheckpoint
from playslot_rl.training.record import StageRecord
from playslot_rl.training.run_stage import Training, on_clips
from playslot_rl.training.stage import ClipStage
from playslot_rl.world_model import module_device

TWO: Final = ("inverse", "forward")
"""As inverse and forward model are stored."""


class LAPOModelStage:
    """Inverse and forward model together, trained in place on pairs of frames of unlabelled videos, and those before
    them; on the frames' `slots` (F, N, D) where these are given.
    """

    def __init__(
        self,
        inverse: QuantisedInverse,
        forward: nn.Module,
        clips: Clips,
        config: StageConfig,
        slots: npt.NDArray[np.float32] | None = None,
    ) -> None:
        self.inverse, self.forward, self.clips, self.config = inverse, forward, clips, config
        device = module_device(inverse)
        self.key = keys.PIXELS
        self.read: Callable[[IntArray], Tensor] = partial(clips.pixels, device=device)
        if slots is not None:
            resident = DeviceRows(lambda rows: torch.from_numpy(slots[rows]), len(slots), device, clips.resident)
            self.key, self.read = keys.SLOTS, resident
        self.ends = Ends.of(clips.source)
        self.seen = self.clips.spread(self.clips.train_episodes)
        frames = normalise(self._frames(self.seen))
        self.still = max(1e-6, float((frames[:, -2] - frames[:, -1]).square().mean()))

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        return {"inverse": self.inverse, "forward": self.forward}

    def batch(self, step: int, generators: StepGenerators) -> Mapping[str, Tensor]:  # noqa: ARG002
        pairs = self.clips.sample(self.config.batch_size, generators.numpy("pairs"))
        return {self.key: self._frames(own_rows(pairs))}

    def loss(self, batch: Mapping[str, Tensor], step: int, generators: StepGenerators) -> Mapping[str, Tensor]:  # noqa: ARG002
        frames = normalise(batch[self.key])
        with autocast(frames.device.type, self.config.precision):
            inferred = self.inverse(frames)
            predicted = self.forward(frames[:, :-1], inferred.z)
        image = (predicted.float() - frames[:, -1]).square().mean() / self.still
        used, perplexity = self._usage(inferred.code.detach())
        return {
            "loss": image + inferred.vq_loss,
            "loss_image": image,
            "loss_vq": inferred.vq_loss,
            "usage": used,
            "perplexity": perplexity,
        }

    def validate(self, step: int) -> Mapping[str, float]:  # noqa: ARG002
        """`unexplained`: error on held-out pairs over that of no change; `perplexity` of the codes (1 to K). Before,
        the inverse model's latents are standardised anew on training pairs.
        """
        self.inverse.settle(normalise(self._frames(rows)) for rows in in_batches(self.seen))

        def look(_: int, rows: IntArray) -> tuple[float, float, Tensor]:
            frames = normalise(self._frames(rows))
            inferred = self.inverse(frames)
            error = float((self.forward(frames[:, :-1], inferred.z) - frames[:, -1]).square().sum())
            return error, float((frames[:, -2] - frames[:, -1]).square().sum()), inferred.code

        errors, stills, codes = zip(*spread(in_batches(self.clips.held_out), look), strict=True)
        _, perplexity = self._usage(torch.cat(codes))
        return {"unexplained": sum(errors) / max(1e-6, sum(stills)), "perplexity": float(perplexity)}

    def _usage(self, code: Tensor) -> tuple[Tensor, Tensor]:
        """Of codes (B, G), as `usage`, in the mean over the codebooks."""
        own = self.inverse.config
        used, perplexity = zip(*(usage(part, own.codes) for part in code.chunk(own.codebooks, dim=1)), strict=True)
        return torch.stack(used).mean(), torch.stack(perplexity).mean()

    def _frames(self, pairs: IntArray) -> Tensor:
        return self.read(self.ends.past(pairs[:, 1], self.inverse.config.frames))


class PixelCloning(LatentCloning):
    """See `LatentCloning`: a policy on frames clones what the model infers from them."""

    def __init__(self, record: StageRecord, shift: int, loss: Literal["l2", "l1"]) -> None:
        config, device = record.config, record.device
        own = getattr(config.baselines, record.name)
        super().__init__(config, record.demos, device, shift, own.policy, loss)
        with global_seed(config.seed, 0, record.name):
            self.policy = LAPOPolicy(own, config.env.image_size, len(config.env.tasks)).to(device)
            self.decoder = self.new_decoder(own.latent_dim, own.hidden)


class LAPOBehaviour(PixelCloning):
    """A CheckpointError where the model is damaged."""

    def __init__(self, record: StageRecord) -> None:
        own: LAPOConfig = record.config.baselines.lapo
        self.inverse, self.targets = load_inverse(record.parents["lapo_model"], record.device), own.targets
        super().__init__(record, own.shift, own.loss)

    def infer(self, source: EpisodeFrames, moves: Transitions) -> Tensor:
        rows = Ends.of(source).past(moves.rows + 1, self.inverse.config.frames)
        return inferred(partial(self.inverse.latents, self.targets), source.pixels, rows, self.device)


def load_inverse(model: StageCheckpoint, device: torch.device | str) -> InverseModel:
    own, (_, env) = model.group(LAPOConfig, NAME), model.sizes
    if "codebooks" not in model.config[NAME]:
        raise CheckpointError(
            f"{model.path}: got LAPO's models of an earlier form (two frames, one codebook), expected those of this "
            "version of playslot_rl: train them again, with another out="
        )
    inverse, _ = model.restore_several(TWO, lambda: (InverseModel(own, env.image_size), ForwardModel(own)), device)
    return inverse


def model(record: StageRecord) -> Training:
    config, device = record.config, record.device
    own: LAPOConfig = config.baselines.lapo
    with global_seed(config.seed, 0, record.name):
        inverse, forward = InverseModel(own, config.env.image_size).to(device), ForwardModel(own).to(device)
    return on_pairs(record, LAPOModelStage(inverse, forward, record.clips(2, shown=256), own.model), own.model)


def on_pairs(
    record: StageRecord, stage: ClipStage, schedule: StageConfig, what: str = "change", labels: str = ""
) -> Training:
    """The training of a model of latent actions by `schedule`, `baselines.METHOD.model`; `what` is `unexplained`."""
    group = f"baselines.{record.name.removesuffix('_model')}.model"
    return on_clips(
        record, stage, schedule, group, lambda m: f"{100 * m['unexplained']:.0f} % of the {what} left", f"pairs{labels}"
    )


def policy(record: StageRecord) -> Training:
    own: LAPOConfig = record.config.baselines.lapo
    return cloning(record, LAPOBehaviour(record), own.decoder_steps, own.decoder_lr)
