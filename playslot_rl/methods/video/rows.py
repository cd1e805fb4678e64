"""The rows a predictor has in the table: as it is, and what puts its number in its place."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from playslot_rl.methods.caddy.model import CADDY
from playslot_rl.methods.svg.model import SVG
from playslot_rl.methods.video.predictor import VideoPredictor
from playslot_rl.methods.video.scores import Predict, as_function
from playslot_rl.methods.video.slots import SlotVideo
from playslot_rl.world_model import module_device


class Row(NamedTuple):
    """One row of a model; `name` is empty for the model as it is, `sees` is what it is told of the true future, and
    `shuffled` takes the latents from another clip.
    """

    name: str
    sees: str
    predict: Predict
    shuffled: bool = False


def method_rows(model: VideoPredictor, seed: int) -> list[Row]:
    """All rows of a trained model in evaluation mode."""
    plain = as_function(model, seed)
    if not model.infers:
        return [Row("", "nothing", plain)]
    told = "actions" if isinstance(model, SlotVideo) and model.needs_actions else "latents"
    rows = [Row("", f"{told} of the true future", plain), Row(f"{told} of another clip", "nothing", plain, True)]
    if isinstance(model, SVG):
        rows.append(Row("latents drawn from the prior", "nothing", _from_prior(model, seed)))
    if isinstance(model, CADDY):
        rows.append(Row("actions alone, v = 0", "actions of the true future", _without_variability(model, seed)))
    return rows


def _from_prior(model: SVG, seed: int) -> Predict:
    generator = torch.Generator(module_device(model)).manual_seed(0)  # one for all clips: each has its own sample

    def predict(frames: Tensor, donors: Tensor | None, actions: Tensor | None) -> Tensor:  # noqa: ARG001
        return model.sample(frames, seed, generator)

    return predict


def _without_variability(model: CADDY, seed: int) -> Predict:
    def predict(frames: Tensor, donors: Tensor | None, actions: Tensor | None) -> Tensor:  # noqa: ARG001
        latents = model.infer(frames)
        return model.rollout(frames[:, :seed], latents._replace(v=torch.zeros_like(latents.v)))

    return predict
