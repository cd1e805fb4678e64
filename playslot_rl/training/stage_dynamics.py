"""Stage 2: InvDyn and cOCVP on the cached slots of a frozen SAVi (paper, appendix A). A `Stage` for `fit`."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from playslot_rl import keys
from playslot_rl.config import DynamicsStageConfig, ModelConfig
from playslot_rl.data.cache import Cache
from playslot_rl.data.clips import Clips
from playslot_rl.data.device_rows import DeviceRows
from playslot_rl.data.drawn_clips import DrawnClips
from playslot_rl.data.slot_cache import slot_cache
from playslot_rl.data.views import IntArray
from playslot_rl.errors import ConfigError, DataError
from playslot_rl.frames import normalise
from playslot_rl.losses.common import total_loss
from playslot_rl.losses.dynamics import DynamicsLoss
from playslot_rl.runtime.captured import Captured
from playslot_rl.runtime.devices import to_device
from playslot_rl.runtime.precision import autocast
from playslot_rl.runtime.processes import spread
from playslot_rl.runtime.shares import own_rows
from playslot_rl.seeds.draws import StepGenerators, global_seed, step_generator
from playslot_rl.storage.checkpoints import load_weights
from playslot_rl.training.record import StageRecord
from playslot_rl.world_model import WorldModel, module_device


class DynamicsStage:
    """Roll out from parsed seed frames under inferred latent actions. SAVi is frozen, the rest is trained in place.

    Args:
        clips: of unlabelled videos, as long as seed and predicted frames.
        slots: cached slots (F, N, D) of the videos.

    Raises:
        ConfigError: mode `ground_truth`, and clips that are drawn.
        DataError: mode `ground_truth`, and no actions, of another width, or such that are no numbers.
    """

    def __init__(
        self, model: WorldModel, clips: Clips, slots: npt.NDArray[np.float32], config: DynamicsStageConfig
    ) -> None:
        self.model, self.clips, self.config = model, clips, config
        self.source, self.device = clips.source, module_device(model)
        self.slots = DeviceRows(lambda rows: torch.from_numpy(slots[rows]), len(slots), self.device, clips.resident)
        self.criterion = DynamicsLoss(model.inverse_dynamics, model.predictor, model.savi, config)
        self._parse = Captured(model.savi, model.savi)
        if self.criterion.needs_actions:
            if isinstance(clips, DrawnClips):
                raise ConfigError(
                    "data.drawn: got true in mode ground_truth, expected false: drawn clips come without actions"
                )
            if not np.isfinite(self.source.require_actions(model.env.action_dim)).all():
                raise DataError(
                    f"{self.source.name}: got NaN or infinite actions, expected finite numbers in mode ground_truth: "
                    "leave those episodes out"
                )
            if self.source.limits is not None:
                self.source.limits.give(model.inverse_dynamics.action_range)

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        return {"inverse_dynamics": self.model.inverse_dynamics, "predictor": self.model.predictor}

    @property
    def frozen(self) -> Mapping[str, nn.Module]:
        """SAVi, whose decoder renders what is predicted."""
        return {"savi": self.model.savi}

    def phase(self, step: int) -> str:
        """In the first `teacher_steps` every input is a parsed slot; then predictions are fed back."""
        return "teacher-forced" if step < self.config.teacher_steps else "rollout"

    def batch(self, step: int, generators: StepGenerators) -> Mapping[str, Tensor]:  # noqa: ARG002
        """Slots and frames of clips, and their actions where they are the latents; drawn clips are parsed here."""
        if not isinstance(self.clips, DrawnClips):
            return self._batch(own_rows(self._sample(generators)))
        frames = self.clips.batch("windows", self.config.batch_size, generators, self.device)
        return {keys.SLOTS: self._parsed(frames, generators), keys.PIXELS: frames}

    def loss(self, batch: Mapping[str, Tensor], step: int, generators: StepGenerators) -> Mapping[str, Tensor]:
        self.model.savi.precision = self.config.precision
        teacher = step < self.config.teacher_steps
        with autocast(self.device.type, self.config.precision):
            out = self.criterion(TensorDict(dict(batch)), generators.torch("latent"), teacher)
        logged = {key: value for key, value in out.items() if not key.startswith("loss_")}
        return {"loss": total_loss(out), "loss_vq": out["loss_vq"], **logged}

    def validate(self, step: int) -> Mapping[str, float]:
        """Errors of autoregressive rollouts on held-out clips, with the latents' means, in fp32, all frames decoded."""
        self.model.savi.precision = "fp32"
        names = ("mse_image", "mse_slot", "psnr", "usage", "perplexity")

        def look(_: int, rows: IntArray) -> list[float]:
            out = self.criterion(TensorDict(self._batch(rows)), step_generator(0, step, "validation", self.device))
            return [float(out[name]) for name in names]

        columns = zip(*spread(self.clips.validation_batches(), look), strict=True)
        return {name: float(np.mean(column)) for name, column in zip(names, columns, strict=True)}

    def _sample(self, generators: StepGenerators) -> IntArray:
        """Rows of the global batch."""
        config, numpy, clips = self.config, generators.numpy("windows"), self.clips
        rows = clips.sample(config.batch_size, numpy)
        if config.from_start > 0:
            first = clips.sample_first(config.batch_size, numpy)
            chosen = numpy.random(config.batch_size) < config.from_start
            rows[chosen] = first[chosen, None] + np.arange(clips.frames)
        return rows

    @torch.no_grad()
    def _parsed(self, frames: Tensor, generators: StepGenerators) -> Tensor:
        """Slots (b, T, N, D) of clips uint8 (b, T, 3, H, W) from their first frame on, in fp32 as the slot cache's."""
        savi, pixels = self.model.savi, normalise(frames)
        savi.precision = "fp32"
        random = savi.config.initial == "gaussian"
        slots: Tensor
        slots, _ = savi(pixels, None, generators.torch("parsing")) if random else self._parse(pixels)
        return slots

    def _batch(self, rows: IntArray) -> dict[str, Tensor]:
        batch = {
            keys.SLOTS: self.slots(rows),
            keys.PIXELS: self.clips.pixels(rows, self.device),
        }
        if self.criterion.needs_actions:
            batch[keys.ACTION] = to_device(torch.from_numpy(self.source.require_actions()[rows]), self.device)
        return batch


def dynamics_on_slots(record: StageRecord, sizes: ModelConfig, own: DynamicsStageConfig) -> DynamicsStage:
    """The stage of a new world model on the SAVi of its parent: its videos are parsed once."""
    config, slots, device = record.config, record.parents["slots"], record.device
    with global_seed(config.seed, 0, record.name):
        world = WorldModel(sizes, config.env)
    load_weights(slots, {"savi": world.savi})
    world.to(device)
    cached = slot_cache(
        record.data, world.savi, slots.fingerprint, Cache.of(config.data), device, config.logging.progress
    )
    return DynamicsStage(world, record.clips(own.seed_frames + own.predicted_frames), cached, own)
