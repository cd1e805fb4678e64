"""Training of SVG-LP, and a trained one from disk."""

from __future__ import annotations

import torch

from playslot_rl.config import EnvConfig
from playslot_rl.methods.svg.config import SVGConfig
from playslot_rl.methods.svg.model import SVG
from playslot_rl.methods.svg.stage import SVGStage
from playslot_rl.methods.video.training import on_clips, pixel_model
from playslot_rl.runs import Run
from playslot_rl.training.record import StageRecord, Training


def training(record: StageRecord) -> Training:
    """A new model."""
    own: SVGConfig = record.config.baselines.svg
    return on_clips(record, SVGStage(pixel_model(SVG, own, record), record.clips(own.frames), own), own)


def load_video(run: Run, device: torch.device | str = "cpu") -> SVG:
    """The model of a finished run.

    Raises:
        CheckpointError: it is missing or damaged.
    """
    done = run.stage("svg")
    own, size = done.group(SVGConfig, "svg"), done.group(EnvConfig, "env").image_size
    return done.restore(lambda: SVG(own, size), "svg", device)
