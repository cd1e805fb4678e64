"""Trainings of LAOM: the latent-action model on unlabelled videos and the labelled demonstrations; then a latent policy
that clones its latents, and an action decoder.

    L = mean (FDM(sg[h_t], z_t) - (e_{t+1} - e_t))^2 / s + lambda mean (W z_u + b - a_u)^2,   s ~ mean (e_{t+1} - e_t)^2

t runs over the videos and u over the moving transitions of the labelled demonstrations, equally many a step; the frames
of a transition are shifted alike. s is an average over the last steps, so that lambda (`label_weight`) counts alike in
all tasks. Targets of the policy are z of one step (k = 1), from frames as they are.

Note: the original's error is not divided, its lambda is 0.001, and it shifts, turns and tilts each frame by itself,
which hides motion of a pixel or two. Our episodes have 20 to 50 steps: k ends with the episode, where the original
leaves out its last K steps.

Shapes: B batch, H W image height and width, M transitions, Z latent-action width.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np
import torch
from torch import Tensor, nn

from playslot_rl import keys
from playslot_rl.data.clips import Clips
from playslot_rl.data.demonstrations import Transitions
from playslot_rl.data.neighbours import Ends, in_batches, pairs_at
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.views import IntArray
from playslot_rl.frames import normalise
from playslot_rl.methods.cloning import cloning, inferred
from playslot_rl.methods.laom.method import NAME, LAOMConfig
from playslot_rl.methods.laom.model import LatentActions, Target
from playslot_rl.methods.lapo.training import PixelCloning, on_pairs
from playslot_rl.methods.supervised import LabelledMoves, jittered
from playslot_rl.runtime.precision import autocast
from playslot_rl.runtime.processes import spread
from playslot_rl.runtime.shares import averaged, own_rows, share
from playslot_rl.seeds.draws import StepGenerators, global_seed
from playslot_rl.storage.checkpoints import StageCheckpoint
from playslot_rl.training.record import StageRecord
from playslot_rl.training.run_stage import Training
from playslot_rl.training.stage_regression import apart, together
from playslot_rl.world_model import module_device

RATE = 0.05
"""Of the average of the features' change."""


class LAOMStage:
    """The model and its target encoder, the model trained in place; `labelled` is None where labels do not count."""

    def __init__(
        self, model: LatentActions, target: Target, clips: Clips, labelled: LabelledMoves | None, config: LAOMConfig
    ) -> None:
        self.model, self.target, self.clips, self.labelled, self.config = model, target, clips, labelled, config
        self.ends = Ends.of(clips.source)
        change = [self.target(*self._frames(rows)) for rows in in_batches(clips.spread(clips.train_episodes))]
        self.target.change.fill_(max(1e-6, float(torch.cat(change).square().mean())))
        self._seen = torch.zeros_like(self.target.change)

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        return {"model": self.model, "target": self.target}

    def batch(self, step: int, generators: StepGenerators) -> Mapping[str, Tensor]:  # noqa: ARG002
        count, device = self.config.model.batch_size, module_device(self.model)
        rows = self.clips.sample(count, generators.numpy("moves"))[:, 0]
        later = self._later(self.ends, rows, generators, "offsets")
        frames = self.clips.pixels(own_rows(np.stack((rows, rows + 1, later), axis=1)), device)
        parts = {"videos": {keys.PIXELS: jittered(frames, self.config.jitter, generators, "jitter")}}
        if self.labelled is not None:
            rows, actions = self.labelled.draw(count, generators)
            later = self._later(self.labelled.ends, rows, generators, "labelled_offsets")
            frames = self.labelled.pixels(own_rows(np.stack((rows, later), axis=1)))
            frames = jittered(frames, self.config.jitter, generators, "labelled_jitter")
            parts["labelled"] = {keys.PIXELS: frames, keys.ACTION: actions}
        return together(parts)

    def loss(self, batch: Mapping[str, Tensor], step: int, generators: StepGenerators) -> Mapping[str, Tensor]:  # noqa: ARG002
        model, videos, labelled = self.model, apart(batch, "videos"), apart(batch, "labelled")
        now, after, later = normalise(videos[keys.PIXELS]).unbind(1)
        known = normalise(labelled[keys.PIXELS]).unbind(1) if labelled else ()
        if model.training and share().micro == 0:
            self.target.follow(model.features, self.config.target_rate)
        with autocast(now.device.type, self.config.model.precision):
            wanted = self.target(now, after)
            h, h_later, *h_known = model.features(torch.cat((now, later, *known))).split(len(now))
            predicted = model.change(h, model.infer(h, h_later))
            actions = model.action(model.infer(*h_known)) if labelled else None
        latent = (predicted.float() - wanted).square().mean() / self._scale(wanted)
        if actions is None:
            return {"loss": latent, "loss_latent": latent}
        action = (actions.float() - labelled[keys.ACTION]).square().mean()
        return {"loss": latent + self.config.label_weight * action, "loss_latent": latent, "loss_action": action}

    @torch.no_grad()
    def validate(self, step: int) -> Mapping[str, float]:  # noqa: ARG002
        """On held-out pairs: `unexplained`, error over that of no change, in the target's features; and `directions`,
        (tr C)^2 / tr C^2 of the latents' covariance C: features that fall into few are easily explained.
        """

        def look(_: int, rows: IntArray) -> tuple[float, float, Tensor]:
            first, second = self._frames(rows)
            h, later = self.model.features(torch.cat((first, second))).chunk(2)
            wanted, z = self.target(first, second), self.model.infer(h, later)
            error = self.model.change(h, z) - wanted
            return float(error.square().sum()), float(wanted.square().sum()), z.float().cpu()

        errors, stills, latents = zip(*spread(in_batches(self.clips.held_out), look), strict=True)
        c = torch.cat(latents).T.cov(correction=0)  # one pair has no directions, not NaN
        directions = float(c.trace().square() / c.square().sum().clamp_min(1e-24))
        return {"unexplained": sum(errors) / max(1e-12, sum(stills)), "directions": directions}

    def _later(self, ends: Ends, rows: IntArray, generators: StepGenerators, stream: str) -> IntArray:
        return ends.ahead(rows, self.config.offset, generators.numpy(stream))

    def _scale(self, wanted: Tensor) -> Tensor:
        """s, as it was before this step; the step's own changes (B, E) are taken in after its last micro-batch."""
        own, scale = share(), self.target.change.clone()
        seen = wanted.square().mean() / own.micros
        self._seen = self._seen + seen if own.micro else seen
        if self.model.training and own.micro == own.micros - 1:
            self.target.change.lerp_(averaged(self._seen), RATE)
        return scale

    def _frames(self, rows: IntArray) -> tuple[Tensor, Tensor]:
        pixels = normalise(self.clips.pixels(rows, module_device(self.model)))
        return pixels[:, 0], pixels[:, 1]


class LAOMBehaviour(PixelCloning):
    """A CheckpointError where the model is damaged."""

    def __init__(self, record: StageRecord) -> None:
        own: LAOMConfig = record.config.baselines.laom
        self.model = load_model(record.parents["laom_model"], record.device)
        super().__init__(record, own.shift, own.loss)

    def infer(self, source: EpisodeFrames, moves: Transitions) -> Tensor:
        return inferred(self.model, source.pixels, pairs_at(moves.rows), self.device)


def built(own: LAOMConfig, image_size: int, action_dim: int) -> tuple[LatentActions, Target]:
    """The model and its target encoder, untrained."""
    model = LatentActions(own, image_size, action_dim)
    return model, Target(model.features, own.channels, image_size)


def load_model(model: StageCheckpoint, device: torch.device | str) -> LatentActions:
    own, (_, env) = model.group(LAOMConfig, NAME), model.sizes
    build = partial(built, own, env.image_size, env.action_dim)
    latents, _ = model.restore_several(("model", "target"), build, device)
    return latents


def model(record: StageRecord) -> Training:
    config, device = record.config, record.device
    own: LAOMConfig = config.baselines.laom
    with global_seed(config.seed, 0, record.name):
        latents, target = built(own, config.env.image_size, config.env.action_dim)
    labelled = None if record.labelled is None else LabelledMoves(record.labelled, config, device)
    stage = LAOMStage(latents.to(device), target.to(device), record.clips(2, shown=256), labelled, own)
    known = 0 if labelled is None else config.behaviour.labelled_demos
    return on_pairs(record, stage, own.model, "features' change", f", {known} labelled")


def policy(record: StageRecord) -> Training:
    own: LAOMConfig = record.config.baselines.laom
    return cloning(record, LAOMBehaviour(record), own.decoder_steps, own.decoder_lr)
