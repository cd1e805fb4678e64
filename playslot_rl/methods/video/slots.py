"""World models on slots as video predictors: PlaySlot with its latents, SlotFormer and OCVP-Seq without.

    S = SAVi(o),   S^_{S+1:T} = rollout(S_{1:S}, InvDyn(S_{1:T})),   o^ = Dec(S^)

Shapes: B batch, T frames of a clip, S seed frames, A action width, H W image height and width.
"""

from __future__ import annotations

import torch
from torch import Tensor

from playslot_rl.methods.video.predictor import check_clip
from playslot_rl.modules.savi import SAVi
from playslot_rl.world_model import WorldModel


def parse(savi: SAVi, frames: Tensor) -> Tensor:
    """Slots (B, T, N, D) of clips (B, T, 3, H, W); initial slots that are drawn are the same at every call."""
    slots: Tensor = savi(frames, generator=torch.Generator(frames.device).manual_seed(0))[0]
    return slots


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
        slots = parse(model.savi, frames)
        p, v = self._latents(slots, actions)
        if donors is not None:  # moves within the seed stay its own
            others = self._latents(parse(model.savi, donors), actions)
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
        decoded: Tensor = self.savi.decode(parse(self.savi, frames)[:, seed:]).frames
        return decoded


class LastFrame:
    """The last seed frame, repeated: what a model of anything has to exceed."""

    infers = False

    def predict(self, frames: Tensor, seed: int, donors: Tensor | None = None) -> Tensor:  # noqa: ARG002
        check_clip(frames, seed)
        return frames[:, seed - 1 : seed].expand_as(frames[:, seed:])
