"""OCVP-Seq with an action token (Villar-Corrales et al., 2023), as the dynamics of SOLD (Mosbach et al., 2025, section
3.2) have it.

    S^_{t+1} = S_t + head(X_t^{1..N}),   X_t^0 = [Lin(S_t), Lin(a_t)] + code(t),   X <- time(objects(X)) in every layer

Shapes: slots (B, T, N, D), actions (B, T, A) -> (B, T, N, D). Several conditions, such as p and v, are one action side
by side. M = N + 1 tokens a step. The first attention of a layer sees the tokens of one step, the second one token's own
past (causal). `residual: false` leaves S_t out. No code tells the slots apart: the model is equivariant to their order.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from playslot_rl.config import PredictorConfig
from playslot_rl.modules.predictors.predictor import AutoregressivePredictor, Condition, Layers
from playslot_rl.modules.transformer import TransformerBlock


class OCVPSeq(AutoregressivePredictor):
    """Action-conditioned slot predictor.

    Args:
        config: sizes; a layer is one block over objects and one over time.
        slot_dim: D.
        action_dim: A, of all conditions together.

    Example:
        >>> import torch
        >>> from playslot_rl.config import PredictorConfig
        >>> model = OCVPSeq(PredictorConfig(layers=1), slot_dim=16, action_dim=4)
        >>> model.rollout(torch.randn(2, 3, 5, 16), torch.rand(2, 7, 4)).shape
        torch.Size([2, 7, 5, 16])
    """

    def __init__(self, config: PredictorConfig, slot_dim: int, action_dim: int) -> None:
        super().__init__(config)
        c = config
        self.embed_slots = nn.Linear(slot_dim, c.dim)
        self.embed_action = nn.Linear(action_dim, c.dim)
        self.objects = nn.ModuleList(TransformerBlock(c.dim, c.heads, c.head_dim, c.mlp_dim) for _ in range(c.layers))
        self.time = nn.ModuleList(TransformerBlock(c.dim, c.heads, c.head_dim, c.mlp_dim) for _ in range(c.layers))
        self.norm = nn.LayerNorm(c.dim)
        self.head = nn.Linear(c.dim, slot_dim)
        self._start_still()

    def _predict(
        self, slots: Tensor, condition: Condition, code: Tensor, mask: Tensor | None, past: Layers | None
    ) -> tuple[Tensor, Layers]:
        b, s, n = slots.shape[:3]
        action = self.embed_action(torch.cat(condition, dim=-1)).unsqueeze(2)
        x = torch.cat((self.embed_slots(slots), action), dim=2) + code
        if mask is not None and mask.dim() > 2:
            mask = mask.repeat_interleave(n + 1, dim=0)
        kept: Layers = []
        for i, (objects, time) in enumerate(zip(self.objects, self.time, strict=True)):
            y, _ = objects(x.reshape(b * s, n + 1, -1))
            y = y.view(b, s, n + 1, -1).transpose(1, 2).reshape(b * (n + 1), s, -1)
            y, keys_values = time(y, mask, None if past is None else past[i])
            kept.append(keys_values)
            x = y.view(b, n + 1, s, -1).transpose(1, 2)
        return self._output(x[:, :, :n], slots), kept
