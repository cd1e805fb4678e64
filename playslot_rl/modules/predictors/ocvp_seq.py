"""SOLD's dynamics: OCVP-Seq with an action token (Mosbach et al., 2025, section 3.2; OCVP-Seq: Villar-Corrales et al.,
2023).

    S^_{t+1} = S_t + head(X_t^{1..N}),   X_t^0 = [Lin(S_t), Lin(a_t)] + code(t),   X <- time(objects(X)) in every layer

Shapes: slots (B, T, N, D), actions (B, T, A) -> (B, T, N, D). M = N + 1 tokens a step. The first attention of a layer
sees the tokens of one step, the second one token's own past (causal). No code tells the slots apart, so the model is
equivariant to their order. Keys and values of the past never change, so a rollout keeps them.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from playslot_rl.modules.transformer import KeysValues, TransformerBlock, sinusoidal_code


class OCVPSeq(nn.Module):
    """Action-conditioned slot predictor.

    Args:
        slot_dim: D.
        action_dim: A.
        dim, layers, heads, mlp_dim: the transformer; a layer is one block over objects and one over time.
        context: most frames that it can see.

    Raises:
        ValueError: `dim` is no multiple of `heads`.

    Example:
        >>> import torch
        >>> model = OCVPSeq(slot_dim=16, action_dim=4, dim=32, layers=1, heads=4, mlp_dim=64, context=8)
        >>> model.rollout(torch.randn(2, 3, 5, 16), torch.rand(2, 7, 4)).shape
        torch.Size([2, 7, 5, 16])
    """

    code: Tensor

    def __init__(
        self, slot_dim: int, action_dim: int, dim: int, layers: int, heads: int, mlp_dim: int, context: int
    ) -> None:
        super().__init__()
        if dim % heads:
            raise ValueError(f"heads: got {heads}, expected a divisor of dim {dim}")
        self.context = context
        self.embed_slots = nn.Linear(slot_dim, dim)
        self.embed_action = nn.Linear(action_dim, dim)
        self.objects = nn.ModuleList(TransformerBlock(dim, heads, dim // heads, mlp_dim) for _ in range(layers))
        self.time = nn.ModuleList(TransformerBlock(dim, heads, dim // heads, mlp_dim) for _ in range(layers))
        self.norm = nn.LayerNorm(dim)
        self.head = nn.Linear(dim, slot_dim)
        # It starts as "nothing moves", which is nearly right from the first step on.
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)
        self.register_buffer("code", sinusoidal_code(context, dim), persistent=False)

    def forward(
        self, slots: Tensor, actions: Tensor, past: list[KeysValues] | None = None
    ) -> tuple[Tensor, list[KeysValues]]:
        """Predict the frame after each of S new frames.

        Args:
            slots: (B, S, N, D).
            actions: (B, S, A) in [-1, 1], taken at these frames.
            past: what the call on the P earlier frames returned.

        Returns:
            Predicted slots (B, S, N, D), entry t is frame t + 1; and the past of the next call.

        Raises:
            ValueError: more than `context` frames.
        """
        b, s, n = slots.shape[:3]
        first = 0 if past is None else past[0][0].shape[2]
        if first + s > self.context:
            raise ValueError(f"frames: got {first + s}, expected at most {self.context} (context + horizon)")
        tokens = torch.cat((self.embed_slots(slots), self.embed_action(actions).unsqueeze(2)), dim=2)
        x = tokens + self.code[first : first + s].view(1, s, 1, -1)
        rows = torch.arange(first, first + s, device=slots.device)
        mask = rows[:, None] >= torch.arange(first + s, device=slots.device) if s > 1 else None
        kept: list[KeysValues] = []
        for i, (objects, time) in enumerate(zip(self.objects, self.time, strict=True)):
            y, _ = objects(x.reshape(b * s, n + 1, -1))
            y = y.view(b, s, n + 1, -1).transpose(1, 2).reshape(b * (n + 1), s, -1)
            y, keys_values = time(y, mask, None if past is None else past[i])
            kept.append(keys_values)
            x = y.view(b, n + 1, s, -1).transpose(1, 2)
        out: Tensor = slots + self.head(self.norm(x[:, :, :n]))
        return out, kept

    def rollout(self, seed: Tensor, actions: Tensor) -> Tensor:
        """Autoregressive rollout: parsed slots inside the seed, its own predictions after it.

        Args:
            seed: parsed slots (B, S, N, D).
            actions: (B, T, A) of frames 1..T, S <= T <= `context`.

        Returns:
            Predicted slots (B, T, N, D) of frames 2..T+1.
        """
        s = seed.shape[1]
        out, past = self(seed, actions[:, :s])
        predictions = [out]
        for t in range(s, actions.shape[1]):
            out, past = self(predictions[-1][:, -1:], actions[:, t : t + 1], past)
            predictions.append(out)
        return torch.cat(predictions, dim=1)
