"""Trainings of Autoencoder BC: L = mean (o^ - o)^2 on frames of unlabelled videos, then the policy on its code.

Shapes: B batch, M rows, H W image height and width.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from playslot_rl import keys
from playslot_rl.config import StageConfig
from playslot_rl.data.clips import Clips
from playslot_rl.data.demonstrations import require_finite
from playslot_rl.data.neighbours import in_batches
from playslot_rl.data.windows import IntArray
from playslot_rl.frames import normalise, psnr
from playslot_rl.methods.autoencoder.method import NAME, AutoencoderBCConfig
from playslot_rl.methods.autoencoder.network import Autoencoder, CodePolicy
from playslot_rl.methods.cloning import action_stage
from playslot_rl.runtime.precision import autocast
from playslot_rl.runtime.processes import spread
from playslot_rl.seeds.draws import StepGenerators, global_seed
from playslot_rl.storage.checkpoints import load_weights
from playslot_rl.training.demonstrated import cloned
from playslot_rl.training.fit import Part
from playslot_rl.training.record import StageRecord
from playslot_rl.training.run_stage import Training
from playslot_rl.world_model import module_device

STANDARDISED = 1024
"""Rows, at most, whose code says its mean and deviation."""


class AutoencoderStage:
    """The autoencoder, trained in place on single frames of unlabelled videos."""

    def __init__(self, network: Autoencoder, clips: Clips, config: StageConfig) -> None:
        self.network, self.clips, self.config = network, clips, config

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        return {"autoencoder": self.network}

    def batch(self, step: int, generators: StepGenerators) -> Mapping[str, Tensor]:  # noqa: ARG002
        device = module_device(self.network)
        return {keys.PIXELS: self.clips.batch("frames", self.config.batch_size, generators, device)[:, 0]}

    def loss(self, batch: Mapping[str, Tensor], step: int, generators: StepGenerators) -> Mapping[str, Tensor]:  # noqa: ARG002
        pixels = normalise(batch[keys.PIXELS])
        with autocast(pixels.device.type, self.config.precision):
            shown = self.network(pixels)
        return {"loss": (shown.float() - pixels).square().mean()}

    def validate(self, step: int) -> Mapping[str, float]:  # noqa: ARG002
        """`psnr` of held-out frames, dB."""

        def look(_: int, rows: IntArray) -> Tensor:
            pixels = normalise(self.clips.pixels(rows[:, 0], module_device(self.network)))
            return psnr((self.network(pixels) - pixels).square().mean(dim=(1, 2, 3)))

        found = spread(in_batches(self.clips.held_out), look)
        return {"psnr": float(torch.cat(found).mean())}


def model(record: StageRecord) -> Training:
    own: AutoencoderBCConfig = getattr(record.config.baselines, NAME)
    with global_seed(record.config.seed, 0, record.name):
        network = Autoencoder(own).to(record.device)
    stage = AutoencoderStage(network, record.clips(1, shown=256), own.model)
    return Training(
        [Part(f"baselines.{NAME}.model", stage, own.model)],
        record.device,
        lambda metrics: (
            f"{record.name}: {metrics.get('psnr', float('nan')):.1f} dB on held-out frames, {record.folder}"
        ),
        extra={"episodes": record.data.episodes},
    )


def policy(record: StageRecord) -> Training:
    config, device, split = record.config, record.device, record.demos
    own: AutoencoderBCConfig = getattr(config.baselines, NAME)
    require_finite(split)
    with global_seed(config.seed, 0, NAME):
        autoencoder = Autoencoder(own)
        network = CodePolicy(
            autoencoder.encoder, config.model.policy, own, config.env.image_size, config.env.action_dim
        )
    load_weights(record.parents["autoencoder"], {"autoencoder": autoencoder})
    network.to(device)
    stage = action_stage(
        "policy", network, keys.PIXELS, lambda x: x, config, split, device, own.shift, own.policy, validated=512
    )
    rows = torch.linspace(0, len(stage.targets) - 1, min(STANDARDISED, len(stage.targets))).long()
    seen = stage.inputs.plain(rows)
    assert isinstance(seen, Tensor)
    network.standardise(seen)
    said, extra = cloned(NAME, split, len(stage.targets))
    return Training(
        [Part(f"baselines.{NAME}.policy", stage, own.policy)],
        device,
        lambda _: f"{said}, {record.folder}",
        extra=extra,
    )
