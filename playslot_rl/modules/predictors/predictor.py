"""What a world model asks of a predictor, and the autoregressive rollout that cOCVP and OCVP-Seq share.

A prediction sees its own and earlier frames only, so keys and values of past frames never change: the rollout keeps
them and is linear in time, with the result of the full computation.

Past the context length the window slides: the last `context` frames are computed anew at positions 0..context-1. That
equals the full computation on that window (evicting old keys instead would not: they hold older frames' content).

Shapes: B batch, T frames, S new frames, P past frames, N slots, D slot width. A condition is what was done at each
frame: (B, T, Z), or (B, T, N, Z) where each slot has its own.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import torch
from torch import Tensor, nn

from playslot_rl.config import PredictorConfig
from playslot_rl.modules.transformer import KeysValues, sinusoidal_code
from playslot_rl.runtime.precision import full_precision

Condition = tuple[Tensor, ...]
Layers = list[KeysValues]


class Predictor(Protocol):
    """Predicts the slots of the next frame; `context` is how many frames it sees at most."""

    context: int
    training: bool

    def __call__(self, slots: Tensor, *condition: Tensor, valid: Tensor | None = None) -> Tensor:
        """Slots (B, T, N, D) of the frame after each given one (B, T, N, D), T at most the context, in one parallel
        pass.

        Args:
            condition: the latent actions taken at these frames, such as p and v.
            valid: bool (B, T), False on left padding (right-aligned histories); positions count valid frames only.
                What is predicted at padding is meaningless.
        """

    def rollout(self, seed: Tensor, *condition: Tensor) -> Tensor:
        """Predict on from its own predictions, after the parsed slots (B, S, N, D) of the seed frames.

        Args:
            condition: of frames 1..T, T >= S: T - S + 1 frames lie past the seed.

        Returns:
            Predicted slots (B, T, N, D) of frames 2..T+1; those inside the seed come from parsed slots.
        """


class Past(NamedTuple):
    """Keys and values of each layer, of so many frames."""

    frames: int
    layers: Layers


class AutoregressivePredictor(nn.Module):
    """A causal transformer over frames. What a token is, and which layers see it, is the subclass's (`_predict`)."""

    code: Tensor
    norm: nn.LayerNorm
    head: nn.Linear

    def __init__(self, config: PredictorConfig) -> None:
        super().__init__()
        self.config, self.context = config, config.context
        self.register_buffer("code", sinusoidal_code(config.context, config.dim), persistent=False)

    def forward(self, slots: Tensor, *condition: Tensor, valid: Tensor | None = None) -> Tensor:
        """See `Predictor.__call__`. Raises ValueError: more frames than the context."""
        if valid is None:
            return self.step(slots, *condition)[0]
        t = slots.shape[1]
        self._check_context(t)
        position = (valid.long().cumsum(dim=1) - 1).clamp(min=0)
        frame = torch.arange(t, device=slots.device)
        # A padded row still sees itself, so that its softmax is finite.
        seen = valid[:, None, :] | (frame[:, None] == frame)
        mask = ((frame[:, None] >= frame) & seen).unsqueeze(1)
        return self._predict(slots, condition, self.code[position].unsqueeze(2), mask, None)[0]

    def step(self, slots: Tensor, *condition: Tensor, past: Past | None = None) -> tuple[Tensor, Past]:
        """Slots (B, S, N, D) of the frame after each of S new frames (B, S, N, D), and the past of the next call;
        `past` is what the call on the P earlier frames returned.

        Raises:
            ValueError: P + S frames are more than the context.
        """
        first, s = 0 if past is None else past.frames, slots.shape[1]
        self._check_context(first + s)
        frame = torch.arange(first + s, device=slots.device)
        mask = frame[first:, None] >= frame if s > 1 else None
        code = self.code[first : first + s].view(1, s, 1, -1)
        out, layers = self._predict(slots, condition, code, mask, None if past is None else past.layers)
        return out, Past(first + s, layers)

    def rollout(self, seed: Tensor, *condition: Tensor) -> Tensor:
        """See `Predictor.rollout`; keys and values are kept, up to the context.

        Raises:
            ValueError: no seed frame, or more than there are actions or than the context holds.
        """
        s, t = self._check_rollout(seed, condition)
        out, past = self.step(seed, *(c[:, :s] for c in condition))
        predictions = [out]
        for i in range(s, min(t, self.context)):
            out, past = self.step(predictions[-1][:, -1:], *(c[:, i : i + 1] for c in condition), past=past)
            predictions.append(out)
        return self._slide(seed, torch.cat(predictions, dim=1), condition, self.context)

    def rollout_full(self, seed: Tensor, *condition: Tensor) -> Tensor:
        """The same rollout without the cache: every step recomputes its whole window."""
        s, _ = self._check_rollout(seed, condition)
        return self._slide(seed, self.forward(seed, *(c[:, :s] for c in condition)), condition, s)

    def _slide(self, seed: Tensor, predicted: Tensor, condition: Condition, start: int) -> Tensor:
        """Predictions from frame `start` on by recomputing the window of the last `context` frames."""
        frames = torch.cat((seed, predicted[:, seed.shape[1] - 1 :]), dim=1)
        for i in range(start, condition[0].shape[1]):
            window = slice(max(0, i + 1 - self.context), i + 1)
            out = self.forward(frames[:, window], *(c[:, window] for c in condition))[:, -1:]
            predicted, frames = torch.cat((predicted, out), dim=1), torch.cat((frames, out), dim=1)
        return predicted

    def _check_context(self, frames: int) -> None:
        if frames > self.context:
            raise ValueError(
                f"frames: got {frames}, expected at most model.predictor.context={self.context}; use rollout"
            )

    def _check_rollout(self, seed: Tensor, condition: Condition) -> tuple[int, int]:
        s, t = seed.shape[1], condition[0].shape[1]
        if not 1 <= s <= min(t, self.context):
            raise ValueError(
                f"seed frames: got {s}, expected 1 to {min(t, self.context)} (actions {t}, context {self.context})"
            )
        return s, t

    def _predict(
        self, slots: Tensor, condition: Condition, code: Tensor, mask: Tensor | None, past: Layers | None
    ) -> tuple[Tensor, Layers]:
        """Predictions (B, S, N, D) of the S new frames and the layers' keys and values; `past` is those of the P
        earlier frames.

        Args:
            code: position code (1 or B, S, 1, dim).
            mask: which frame sees which, bool (S, P + S) or (B, 1, S, P + S); None: all.
        """
        raise NotImplementedError

    def _output(self, x: Tensor, slots: Tensor) -> Tensor:
        """The head on the slots' tokens (..., dim), which it reads as of the slots' shape."""
        with full_precision(x.device.type):
            out: Tensor = self.head(self.norm(x)).view(slots.shape)
        return slots + out if self.config.residual else out

    def _start_still(self) -> None:
        """A residual model starts as "nothing moves", which is nearly right from the first step on."""
        if self.config.residual:
            nn.init.zeros_(self.head.weight)
            nn.init.zeros_(self.head.bias)
