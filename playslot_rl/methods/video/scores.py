"""Scores of a video predictor on held-out clips, clip by clip and step by step: as it is, and what puts its
number in its place.

Shapes: C clips, T frames of a clip, S seed frames, P predicted frames, H W image height and width.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from playslot_rl.data.neighbours import in_batches
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.views import IntArray
from playslot_rl.evaluation.video import frame_scores
from playslot_rl.frames import normalise, to_uint8
from playslot_rl.methods.caddy.model import CADDY
from playslot_rl.methods.svg.model import SVG
from playslot_rl.methods.video.predictor import SlotVideo, VideoPredictor
from playslot_rl.world_model import module_device

BATCH = 8
Predict = Callable[[Tensor, Tensor | None, Tensor | None], Tensor]
"""Frames (C, T, 3, H, W), donors of the same shape or None, and real actions (C, T - 1, A) or None, to (C, P, ...)."""


def as_function(model: VideoPredictor, seed: int) -> Predict:

    def predict(frames: Tensor, donors: Tensor | None, actions: Tensor | None) -> Tensor:
        if isinstance(model, SlotVideo) and model.needs_actions:
            return model.predict(frames, seed, donors, actions)
        return model.predict(frames, seed, donors)

    return predict


@torch.no_grad()
def score_clips(
    predict: Predict,
    source: EpisodeFrames,
    rows: IntArray,
    seed: int,
    device: torch.device | str,
    *,
    lpips: nn.Module | None = None,
    shuffled: bool = False,
    shown: int = 0,
) -> tuple[dict[str, Any], npt.NDArray[np.uint8]]:
    """Predict the frames past the seed of each clip, and compare.

    Args:
        rows: row numbers of the clips' frames, int64 (C, T).
        shuffled: latents, or real actions, past the seed come from the next clip, so that none keeps its own.
        shown: of so many first clips the predictions are kept.

    Returns:
        `psnr`, `ssim` and `lpips` (None without a network): lists (C, P); and frames (shown, P, H, W, 3).

    Raises:
        ValueError: latents of one clip alone cannot be shuffled.
    """
    if shuffled and len(rows) < 2:
        raise ValueError(f"clips: got {len(rows)}, expected at least 2 to shuffle latents between them")
    found: dict[str, list[Tensor]] = {"psnr": [], "ssim": [], "lpips": []}
    pictures: list[npt.NDArray[np.uint8]] = []
    order = np.roll(np.arange(len(rows)), -1)
    for part in in_batches(np.arange(len(rows)), BATCH):
        frames = normalise(source.pixels(rows[part]).to(device))
        donors = normalise(source.pixels(rows[order[part]]).to(device)) if shuffled else None
        actions = None
        if source.actions is not None:
            moves = source.actions[rows[part][:, :-1]]
            if shuffled:
                moves = np.concatenate(
                    (moves[:, : seed - 1], source.actions[rows[order[part]][:, seed - 1 : -1]]), axis=1
                )
            actions = torch.from_numpy(moves).to(device)
        predicted = predict(frames, donors, actions)
        scores = frame_scores(predicted, frames[:, seed:], lpips)
        for name, values in scores._asdict().items():
            if values is not None:
                found[name].append(values.cpu())
        pictures.append(to_uint8(predicted[: max(0, shown - sum(map(len, pictures)))]))
    result = {name: torch.cat(values).double().tolist() if values else None for name, values in found.items()}
    return result, np.concatenate(pictures)


class Row(NamedTuple):
    """One row of a model; `name` is empty for the model as it is, `sees` is what it is told of the true future, and
    `shuffled` takes the latents from another clip.
    """

    name: str
    sees: str
    predict: Predict
    shuffled: bool = False


def method_rows(model: VideoPredictor, seed: int) -> list[Row]:
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
