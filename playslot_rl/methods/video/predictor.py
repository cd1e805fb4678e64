"""What the video comparison asks of a model (paper, section 4.1), frames after some seed frames; and what world models
on slots answer: PlaySlot with its latents, SlotFormer and OCVP-Seq without.

    S = SAVi(o),   S^_{S+1:T} = rollout(S_{1:S}, InvDyn(S_{1:T})),   o^ = Dec(S^)

Shapes: B batch, T frames of a clip, S seed frames, A action width, H W image height and width.
"""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from playslot_rl.modules.savi import SAVi
from playslot_rl.world_model import WorldModel


class VideoPredictor(Protocol):
    """Predicts frames.

    Attributes:
        infers: whether it reads latents off the true future (SVG-LP, CADDY, PlaySlot); one that does not (SlotFormer,
            OCVP-Seq) sees nothing but the seed.
    """

    infers: bool

    def predict(self, frames: Tensor, seed: int, donors: Tensor | None = None) -> Tensor:
        """Frames (B, T - S, 3, H, W), float, about [0, 1], after the seed, each from its own predictions.

        What a frame past the seed shows enters through the latents alone, and with `donors` not even there.

        Args:
            frames: clips (B, T, 3, H, W), float [0, 1].
            seed: S, at least 1 and less than T, else a ValueError.
            donors: clips of the same shape from whose future the latents are inferred instead; whether these steer the
                prediction shows in the difference. Not looked at where nothing is inferred.
        """


def check_clip(frames: Tensor, seed: int) -> None:
    """Refuse clips that have no frame past the seed."""
    if not 1 <= seed < frames.shape[1]:
        raise ValueError(f"clip: got {frames.shape[1]} frames with {seed} seed frames, expected more, and a seed")


class SlotVideo:
    """A world model in evaluation mode as a `VideoPredictor`."""

    def __init__(self, model: WorldModel) -> None:
        self.model = model
        mode = model.inverse_dynamics.config.mode
        self.infers, self.needs_actions = mode != "none", mode == "ground_truth"

    @torch.no_grad()
    def predict(self, frames: Tensor, seed: int, donors: Tensor | None = None, actions: Tensor | None = None) -> Tensor:
        """See `VideoPredictor`; mode `ground_truth` needs the real actions (B, T - 1, A), else a ValueError."""
        check_clip(frames, seed)
        model = self.model
        slots = model.savi.parse(frames)
        p, v = self._latents(slots, actions)
        if donors is not None:  # moves within the seed stay its own
            others = self._latents(model.savi.parse(donors), actions)
            p, v = (torch.cat((a[:, : seed - 1], b[:, seed - 1 :]), dim=1) for a, b in zip((p, v), others, strict=True))
        # SAVi is causal: of the true future nothing but latents is handed on.
        predicted = model.predictor.rollout(slots[:, :seed], p, v)[:, seed - 1 :]
        decoded: Tensor = model.savi.decode(predicted).frames
        return decoded

    def _latents(self, slots: Tensor, actions: Tensor | None) -> tuple[Tensor, Tensor]:
        latent = self.model.inverse_dynamics(slots, actions)
        return latent.prototype, latent.variability


class Reconstruction:
    """SAVi's reconstruction of the true frames: what no model on its slots can exceed."""

    infers = True

    def __init__(self, savi: SAVi) -> None:
        self.savi = savi

    @torch.no_grad()
    def predict(self, frames: Tensor, seed: int, donors: Tensor | None = None) -> Tensor:  # noqa: ARG002
        check_clip(frames, seed)
        decoded: Tensor = self.savi.decode(self.savi.parse(frames)[:, seed:]).frames
        return decoded


class LastFrame:
    """The last seed frame, repeated: what a model of anything has to exceed."""

    infers = False

    def predict(self, frames: Tensor, seed: int, donors: Tensor | None = None) -> Tensor:  # noqa: ARG002
        check_clip(frames, seed)
        return frames[:, seed - 1 : seed].expand_as(frames[:, seed:])
