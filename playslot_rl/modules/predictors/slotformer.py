"""SlotFormer (Wu et al., 2023): slots of the next frame from those of the last few, without actions.

    S^_{t+1} = S_t + W_out X_t,   X = Transformer(W_in S_{t-C+1:t} + code(age))

Shapes: slots (B, T, N, D) -> (B, T, N, D). A window of C frames is C N tokens that all see each other. The code says
how many frames before the newest a token is; it is the same for all slots of a frame, so that the model is equivariant
to their order. `residual: false` leaves S_t out.

Since every token of a window sees every other, nothing can be kept from one step to the next: each prediction computes
its window anew.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from playslot_rl.config import PredictorConfig
from playslot_rl.modules.predictors.predictor import Condition
from playslot_rl.modules.transformer import TransformerBlock, sinusoidal_code
from playslot_rl.runtime.precision import full_precision


class SlotFormer(nn.Module):
    """Slot predictor without control.

    Note: the original predicts the slots themselves and has an MLP with dropout; here it predicts their change where
    `config.residual` says so, and has no dropout, as cOCVP.

    Args:
        config: sizes; `context` is C.

    Example:
        >>> model = SlotFormer(PredictorConfig(layers=1, context=6), slot_dim=16)
        >>> model.rollout(torch.randn(2, 3, 5, 16), torch.zeros(2, 7, 0)).shape
        torch.Size([2, 7, 5, 16])
    """

    code: Tensor

    def __init__(self, config: PredictorConfig, slot_dim: int) -> None:
        super().__init__()
        c = config
        self.config, self.context = config, config.context
        self.embed_slots = nn.Linear(slot_dim, c.dim)
        self.blocks = nn.ModuleList(
            TransformerBlock(c.dim, c.heads, c.head_dim, c.mlp_dim, c.project_out) for _ in range(c.layers)
        )
        self.head = nn.Linear(c.dim, slot_dim)
        self.register_buffer("code", sinusoidal_code(c.context, c.dim), persistent=False)
        if c.residual:  # it starts as "nothing moves"
            nn.init.zeros_(self.head.weight)
            nn.init.zeros_(self.head.bias)

    def forward(self, slots: Tensor, *condition: Tensor, valid: Tensor | None = None) -> Tensor:  # noqa: ARG002
        """See `Predictor.__call__`; of the condition nothing is read, and T may be more than the context."""
        b, t = slots.shape[:2]
        seen = torch.ones(b, t, dtype=torch.bool, device=slots.device) if valid is None else valid
        window = min(self.context, t)
        frame = torch.arange(t, device=slots.device)
        # Row i of a window that ends at frame t is frame t - window + 1 + i; before the first there is nothing.
        of = frame[:, None] - window + 1 + torch.arange(window, device=slots.device)
        there = seen[:, of.clamp(min=0)] & (of >= 0)
        there[..., -1].fill_(True)  # a padded frame still sees itself, so that its softmax is finite
        missing = window > 1 or valid is not None
        out = self._next(slots[:, of.clamp(min=0)].flatten(0, 1), there.flatten(0, 1) if missing else None)
        return out.view(b, t, *out.shape[1:])

    def rollout(self, seed: Tensor, *condition: Tensor) -> Tensor:
        """See `Predictor.rollout`; of the condition only its length is read.

        Raises:
            ValueError: no seed frame, or more than there are frames in the condition.
        """
        s, t = self._check_rollout(seed, condition)
        frames, predictions = seed, [self.forward(seed)]
        for _ in range(s, t):
            frames = torch.cat((frames, predictions[-1][:, -1:]), dim=1)[:, -self.context :]
            predictions.append(self._next(frames, None)[:, None])
        return torch.cat(predictions, dim=1)

    def _check_rollout(self, seed: Tensor, condition: Condition) -> tuple[int, int]:
        s, t = seed.shape[1], condition[0].shape[1]
        if not 1 <= s <= t:
            raise ValueError(f"seed frames: got {s}, expected 1 to {t}, the frames to predict from")
        return s, t

    def _next(self, window: Tensor, there: Tensor | None) -> Tensor:
        """Slots (B, N, D) of the frame after a window (B, W, N, D), of whose frames some are `there` (B, W)."""
        w, n = window.shape[1:3]
        code = self.code[:w].flip(0)
        x = (self.embed_slots(window) + code[None, :, None]).flatten(1, 2)
        mask = None
        if there is not None:
            mask = there.repeat_interleave(n, dim=1)[:, None, None, :]
        for i, block in enumerate(self.blocks):
            last = i == len(self.blocks) - 1
            x, _ = block(x, mask, wanted=slice(-n, None) if last else slice(None))
        with full_precision(x.device.type):
            out: Tensor = self.head(x)
        return window[:, -1] + out if self.config.residual else out
