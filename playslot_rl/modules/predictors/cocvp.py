"""cOCVP: slots of the next frame from past slots and latent actions (system.md section 3; paper, section "Conditional
Object-Centric Prediction").

    S^_{t+1} = head(Transformer(Lin(S_{1:t}) + Lin(p_{1:t}) + Lin(v_{1:t}) + code(t)))

Shapes: slots (B, T, N, D), p and v (B, T, Z) (added to every slot) or (B, T, N, Z) (each to its slot) -> (B, T, N, D).
The mask is causal over frames and full within a frame, so keys and values of past frames never change: the rollout
keeps them and is linear in time, with the result of the full computation.

Past the context length the window slides: the last `context` frames are computed anew at positions 0..context-1. That
equals the full computation on that window (evicting old keys instead would not: they hold older frames' content).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from playslot_rl.config import PredictorConfig
from playslot_rl.modules.transformer import KeysValues, TransformerBlock, sinusoidal_code


class COCVP(nn.Module):
    """Conditional object-centric video predictor.

    Args:
        config: sizes.
        slot_dim: D.
        latent_dim: Z.

    Example:
        >>> import torch
        >>> from playslot_rl.config import PredictorConfig
        >>> model = COCVP(PredictorConfig(), slot_dim=128, latent_dim=16)
        >>> z = torch.randn(2, 5, 16)
        >>> model.rollout(torch.randn(2, 1, 4, 128), z, z).shape
        torch.Size([2, 5, 4, 128])
    """

    code: Tensor

    def __init__(self, config: PredictorConfig, slot_dim: int, latent_dim: int) -> None:
        super().__init__()
        self.config = config
        c = config
        self.embed_slots = nn.Linear(slot_dim, c.dim)
        self.embed_prototype = nn.Linear(latent_dim, c.dim)
        self.embed_variability = nn.Linear(latent_dim, c.dim)
        self.blocks = nn.ModuleList(TransformerBlock(c.dim, c.heads, c.head_dim, c.mlp_dim) for _ in range(c.layers))
        self.norm = nn.LayerNorm(c.dim)
        self.head = nn.Linear(c.dim, slot_dim)
        if c.residual:
            # A residual model starts as "nothing moves", which is nearly right from the first step on.
            nn.init.zeros_(self.head.weight)
            nn.init.zeros_(self.head.bias)
        self.register_buffer("code", sinusoidal_code(c.context, c.dim), persistent=False)

    def _tokens(self, slots: Tensor, p: Tensor, v: Tensor, code: Tensor) -> Tensor:
        action = self.embed_prototype(p) + self.embed_variability(v)
        if p.dim() == 3:
            action = action.unsqueeze(2)
        tokens: Tensor = self.embed_slots(slots) + action + code
        return tokens.flatten(1, 2)

    def _output(self, x: Tensor, slots: Tensor) -> Tensor:
        out: Tensor = self.head(self.norm(x)).view(slots.shape)
        return slots + out if self.config.residual else out

    def forward(self, slots: Tensor, p: Tensor, v: Tensor, valid: Tensor | None = None) -> Tensor:
        """Predict the frame after each given frame, in one parallel pass.

        Args:
            slots: (B, T, N, D), T at most the context.
            p, v: latent action taken at each frame, (B, T, Z) or (B, T, N, Z).
            valid: bool (B, T), False on left padding (right-aligned histories); positions count valid frames only.

        Returns:
            Predicted slots (B, T, N, D); entry t is frame t+1. Entries of padding are meaningless.

        Raises:
            ValueError: more frames than the context.
        """
        t, n = slots.shape[1:3]
        if t > self.config.context:
            raise ValueError(
                f"frames: got {t}, expected at most model.predictor.context={self.config.context}; use rollout"
            )
        frame = torch.arange(t, device=slots.device).repeat_interleave(n)
        mask = frame[:, None] >= frame[None, :]
        if valid is None:
            code = self.code[:t].view(1, t, 1, -1)
        else:
            position = (valid.long().cumsum(dim=1) - 1).clamp(min=0)
            code = self.code[position].unsqueeze(2)
            # A padded row still sees itself, so that its softmax is finite.
            seen = valid.repeat_interleave(n, dim=1)[:, None, :] | (frame[:, None] == frame[None, :])
            mask = (mask & seen).unsqueeze(1)
        x = self._tokens(slots, p, v, code)
        for block in self.blocks:
            x, _ = block(x, mask)
        return self._output(x, slots)

    def rollout(self, seed: Tensor, p: Tensor, v: Tensor) -> Tensor:
        """Autoregressive rollout with cached keys and values.

        Args:
            seed: parsed slots (B, S, N, D) of the seed frames.
            p, v: latent actions (B, T, Z) or (B, T, N, Z) at frames 1..T, T >= S: T - S + 1 frames lie past the seed.

        Returns:
            Predicted slots (B, T, N, D) of frames 2..T+1; those inside the seed come from parsed slots.
        """
        s, t, n, context = seed.shape[1], p.shape[1], seed.shape[2], self.config.context
        self._check_rollout(s, t)
        frame = torch.arange(s, device=seed.device).repeat_interleave(n)
        out, cache = self._step(seed, p[:, :s], v[:, :s], 0, frame[:, None] >= frame[None, :], None)
        predictions = [out]
        for i in range(s, min(t, context)):
            current = predictions[-1][:, -1:]
            out, cache = self._step(current, p[:, i : i + 1], v[:, i : i + 1], i, None, cache)
            predictions.append(out)
        return self._slide(seed, torch.cat(predictions, dim=1), p, v, context)

    def rollout_full(self, seed: Tensor, p: Tensor, v: Tensor) -> Tensor:
        """The same rollout without the cache: every step recomputes its whole window."""
        self._check_rollout(seed.shape[1], p.shape[1])
        s = seed.shape[1]
        return self._slide(seed, self.forward(seed, p[:, :s], v[:, :s]), p, v, s)

    def _check_rollout(self, seed: int, steps: int) -> None:
        if not 1 <= seed <= min(steps, self.config.context):
            raise ValueError(
                f"seed frames: got {seed}, expected 1 to {min(steps, self.config.context)} "
                f"(actions {steps}, context {self.config.context})"
            )

    def _step(
        self, slots: Tensor, p: Tensor, v: Tensor, first: int, mask: Tensor | None, cache: list[KeysValues] | None
    ) -> tuple[Tensor, list[KeysValues]]:
        """Predict after new frames at positions first, first + 1, ..., given the cache of all earlier ones."""
        code = self.code[first : first + slots.shape[1]].view(1, slots.shape[1], 1, -1)
        x = self._tokens(slots, p, v, code)
        kept: list[KeysValues] = []
        for i, block in enumerate(self.blocks):
            x, keys_values = block(x, mask, None if cache is None else cache[i])
            kept.append(keys_values)
        return self._output(x, slots), kept

    def _slide(self, seed: Tensor, predicted: Tensor, p: Tensor, v: Tensor, start: int) -> Tensor:
        """Predictions from frame `start` on by recomputing the window of the last `context` frames."""
        steps = p.shape[1]
        frames = torch.cat((seed, predicted[:, seed.shape[1] - 1 :]), dim=1)
        for i in range(start, steps):
            low = max(0, i + 1 - self.config.context)
            out = self.forward(frames[:, low : i + 1], p[:, low : i + 1], v[:, low : i + 1])[:, -1:]
            predicted, frames = torch.cat((predicted, out), dim=1), torch.cat((frames, out), dim=1)
        return predicted
