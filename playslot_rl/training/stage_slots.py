"""Stage 1: SAVi on unlabelled clips (paper, appendix A.1). A `Stage` for `playslot_rl.training.fit`."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import numpy.typing as npt
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from playslot_rl import keys
from playslot_rl.colours import segmentation
from playslot_rl.config import SlotsStageConfig
from playslot_rl.data.clips import Clips
from playslot_rl.data.views import IntArray
from playslot_rl.data.zoom import corners, magnified
from playslot_rl.errors import CheckpointError
from playslot_rl.frames import psnr, to_uint8
from playslot_rl.losses.slots import SlotsLoss, background
from playslot_rl.modules.savi import Decoded, SAVi
from playslot_rl.modules.savi.health import SlotHealth
from playslot_rl.runtime.processes import spread
from playslot_rl.runtime.shares import own_rows
from playslot_rl.seeds.draws import StepGenerators, step_generator
from playslot_rl.training.slot_warnings import slot_warnings
from playslot_rl.world_model import module_device

INITIAL_SLOTS = "initializer.mean"


class SlotsStage:
    """Reconstruct clips of unlabelled videos from slots; `segmented` adds numbers to each validation, from what a
    simulator knows of the objects, on one rank.
    """

    def __init__(
        self,
        savi: SAVi,
        clips: Clips,
        config: SlotsStageConfig,
        segmented: Callable[[SAVi], Mapping[str, float]] | None = None,
    ) -> None:
        self.savi, self.clips, self.config, self.device = savi, clips, config, module_device(savi)
        self.segmented = segmented
        usual = None
        if config.foreground_weight:
            usual = torch.stack([background(clips.pixels(rows, self.device)) for rows in clips.scenes()])
        self.criterion = SlotsLoss(savi, config.motion_weight, config.foreground_weight, usual)
        self.magnified = SlotsLoss(savi, config.motion_weight)  # magnified frames have another background

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        return {"savi": self.savi}

    def phase(self, step: int) -> str:
        """In the first `zoom_steps` single frames, magnified; then clips."""
        return "magnified" if step < self.config.zoom_steps else "clips"

    def batch(self, step: int, generators: StepGenerators) -> Mapping[str, Tensor]:
        """Clips; in the first `zoom_steps` their first frames, magnified.

        Note: the paper shows clips as they are. One colour explains most pixels of a plain ground, and Slot Attention
        averages over all of them, so that small things hardly change what it sees; magnified they do, and slots that
        have learned to take large things apart go on with small ones. One frame is enough for that.
        """
        own, count, zooms = self.config, self.config.batch_size, step < self.config.zoom_steps
        frames = self.clips.batch("windows", count, generators, self.device, 1 if zooms else None)
        if not zooms:
            return {keys.PIXELS: frames}
        at = own_rows(corners(count, self.savi.image_size, own.zoom, generators.numpy("zoom")))
        return {keys.PIXELS: magnified(frames, own.zoom, at)}

    def loss(self, batch: Mapping[str, Tensor], step: int, generators: StepGenerators) -> Mapping[str, Tensor]:
        self.savi.precision = self.config.precision
        criterion = self.magnified if step < self.config.zoom_steps else self.criterion
        out = criterion(TensorDict(dict(batch)), generator=generators.torch("slots"))
        return {"loss": out["loss_reconstruction"], "psnr": out["psnr"]}

    def validate(self, step: int) -> Mapping[str, float]:
        """PSNR (dB) and the slots' health (`playslot_rl.modules.savi.health`) on held-out clips, in fp32."""
        self.savi.precision = "fp32"

        def look(_: int, rows: IntArray) -> tuple[float, SlotHealth]:
            frames, decoded = self._parse(rows, step)
            health = SlotHealth(self.savi.config.n_slots)
            health.add(frames, decoded.frames, decoded.masks)
            return float((decoded.frames - frames).square().mean()), health

        errors, found = zip(*spread(self.clips.validation_batches(), look), strict=True)
        health = SlotHealth(self.savi.config.n_slots)
        for part in found:
            health.join(part)
        mse = float(np.mean(errors))
        known = self.segmented(self.savi) if self.segmented is not None else {}
        return {"mse": mse, "psnr": float(psnr(torch.tensor(mse))), **health.values(), **known}

    def warnings(self, step: int, values: Mapping[str, float]) -> Mapping[str, str]:
        """What the last validation says is wrong with the slots, and the known cure; nothing in the first quarter or
        while frames are magnified, in which slots have not taken the scene apart yet.
        """
        known = 4 * step >= self.config.steps and step > self.config.zoom_steps
        return slot_warnings(values, self.savi.config, self.config) if known else {}

    def pictures(self, step: int) -> Mapping[str, npt.NDArray[np.uint8]]:
        """The first held-out clip, (3 H, T W, 3): frames, reconstructions, segmentation."""
        self.savi.precision = "fp32"
        frames, decoded = self._parse(self.clips.held_out[:1], step)
        drawn = to_uint8(decoded.frames[0])
        rows = [to_uint8(frames[0]), drawn, segmentation(drawn, decoded.masks[0].cpu().numpy())]
        return {"slots": np.concatenate([np.concatenate(list(row), 1) for row in rows])}

    def _parse(self, rows: IntArray, step: int) -> tuple[Tensor, Decoded]:
        frames = TensorDict({keys.PIXELS: self.clips.pixels(rows, self.device)})
        return self.criterion.reconstruct(frames, step_generator(0, step, "validation", self.device))


def warm_start(savi: SAVi, source: SAVi, where: str) -> None:
    """Copy weights in place. With another number of learned initial slots the first ones are copied and the rest kept;
    a CheckpointError, with the name `where`, where other sizes differ.

    Note: the paper trains each SAVi from scratch. Slot Attention first fits what all frames share and only then takes
    scenes apart; where objects are small and of any colour, that plateau outlasts what a CPU can pay for, and a SAVi
    that has learned elsewhere to take scenes apart leaves it early.
    """
    own, other = savi.state_dict(), source.state_dict()
    got, expected = ({name: tuple(value.shape) for name, value in state.items()} for state in (other, own))
    for name in sorted({*own, *other} - {INITIAL_SLOTS}):
        if got.get(name) != expected.get(name):
            raise CheckpointError(
                f"slots.start_from={where}: got {name} of {got.get(name, 'nothing')}, expected "
                f"{expected.get(name, 'nothing')}: give model.savi.* its sizes, or start from scratch "
                "(slots.start_from=)"
            )
    with torch.no_grad():
        rows = min(len(own[INITIAL_SLOTS]), len(other[INITIAL_SLOTS]))
        initial = own[INITIAL_SLOTS].clone()
        initial[:rows] = other[INITIAL_SLOTS][:rows]
    savi.load_state_dict({**other, INITIAL_SLOTS: initial})
