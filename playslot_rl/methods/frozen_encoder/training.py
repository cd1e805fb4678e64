"""Trainings of the model of unlabelled videos; then of a policy on its encoder's code, which stays.

    L = mean (o^ - o)^2     of the frame that the model shows

Note: inverse dynamics of real actions would need videos with labels; from the labelled demonstrations alone it is what
ResNet BC learns from. So the actions are latent.

Shapes: B batch, T frames, H W image height and width, M rows.
"""

from __future__ import annotations

from collections.abc import Mapping
from operator import attrgetter

import torch
from torch import Tensor, nn

from playslot_rl import keys
from playslot_rl.config import StageConfig
from playslot_rl.config.stage_spec import group_of
from playslot_rl.data.clips import Clips
from playslot_rl.data.demonstrations import require_finite
from playslot_rl.data.neighbours import in_batches
from playslot_rl.data.views import IntArray
from playslot_rl.frames import normalise, psnr
from playslot_rl.methods.cloning import action_stage
from playslot_rl.methods.frozen_encoder.method import EncoderBCConfig
from playslot_rl.methods.frozen_encoder.network import CodePolicy, VideoEncoder, video_encoder
from playslot_rl.runtime.precision import autocast
from playslot_rl.runtime.processes import spread
from playslot_rl.seeds.draws import StepGenerators, global_seed
from playslot_rl.storage.checkpoints import load_weights
from playslot_rl.training.demonstrated import cloning_alone
from playslot_rl.training.fit import Part
from playslot_rl.training.record import StageRecord
from playslot_rl.training.run_stage import Training, on_clips
from playslot_rl.world_model import module_device

STANDARDISED = 1024
"""Rows, at most, whose code says its mean and deviation."""


class EncoderStage:
    """The model, kept as `name`, trained in place on frames of unlabelled videos."""

    def __init__(self, name: str, network: VideoEncoder, clips: Clips, config: StageConfig) -> None:
        self.name, self.network, self.clips, self.config = name, network, clips, config

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        return {self.name: self.network}

    def batch(self, step: int, generators: StepGenerators) -> Mapping[str, Tensor]:  # noqa: ARG002
        device = module_device(self.network)
        return {keys.PIXELS: self.clips.batch("frames", self.config.batch_size, generators, device)}

    def loss(self, batch: Mapping[str, Tensor], step: int, generators: StepGenerators) -> Mapping[str, Tensor]:  # noqa: ARG002
        pixels = normalise(batch[keys.PIXELS])
        with autocast(pixels.device.type, self.config.precision):
            shown = self.network.shown(pixels)
        return {"loss": (shown.float() - pixels[:, -1]).square().mean()}

    def validate(self, step: int) -> Mapping[str, float]:  # noqa: ARG002
        """`psnr` of held-out frames, dB; of pairs also `unexplained`, the error over that of no change."""

        def look(_: int, rows: IntArray) -> Tensor:
            pixels = normalise(self.clips.pixels(rows, module_device(self.network)))
            errors = (shown - pixels[:, -1] for shown in (self.network.shown(pixels), pixels[:, 0]))
            return torch.stack([error.square().mean(dim=(1, 2, 3)) for error in errors])

        error, still = torch.cat(spread(in_batches(self.clips.held_out), look), dim=1)
        found = {"psnr": float(psnr(error).mean())}
        return {**found, "unexplained": float(error.sum() / still.sum())} if bool(still.any()) else found


def _settings(record: StageRecord) -> EncoderBCConfig:
    found: EncoderBCConfig = attrgetter(group_of(record.spec.settings[0]))(record.config)
    return found


def model(record: StageRecord) -> Training:
    own = _settings(record)
    with global_seed(record.config.seed, 0, record.name):
        network = video_encoder(own, record.config.env.image_size).to(record.device)
    stage = EncoderStage(record.name, network, record.clips(network.frames, shown=256), own.model)
    return on_clips(record, stage, own.model, f"{own.group}model", lambda m: f"{m['psnr']:.1f} dB", "frames")


def policy(record: StageRecord) -> Training:
    config, device, split = record.config, record.device, record.demos
    own, (parent,) = _settings(record), record.spec.parents
    require_finite(split)
    with global_seed(config.seed, 0, record.name):
        encoder, env = video_encoder(own, config.env.image_size), config.env
        sizes = own.code, env.image_size, env.action_dim, len(env.tasks)
        network = CodePolicy(encoder.encoder, config.model.policy, *sizes)
    load_weights(record.parents[parent], {parent: encoder})
    network.to(device)
    stage = action_stage(
        "policy", network, keys.PIXELS, lambda x: x, config, split, device, own.shift, own.policy, validated=512
    )
    rows = torch.linspace(0, len(stage.targets) - 1, min(STANDARDISED, len(stage.targets))).long()
    seen = stage.inputs.plain(rows)
    network.eval().standardise(seen if isinstance(seen, Tensor) else seen[0])
    return cloning_alone(record, Part(f"{own.group}policy", stage, own.policy), len(stage.targets))
