"""OCVP-Seq (Villar-Corrales et al., 2023), with an action token as the dynamics of SOLD (Mosbach et al., 2025, section
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
    """Slot predictor, conditioned on actions where there are any.

    Note: OCVP-Seq attends over time without a mask. Here a frame sees its past only, so that a prediction does not
    depend on what comes after it and keys and values can be kept; sizes and parameters are the same, but for a
    LayerNorm before the head (2 dim parameters), as the other predictors have it.

    Args:
        config: sizes; a layer is one block over objects and one over time.
        action_dim: A, of all conditions together; 0 has none.

    Example:
        >>> model = OCVPSeq(PredictorConfig(layers=1), slot_dim=16, action_dim=4)
        >>> model.rollout(torch.randn(2, 3, 5, 16), torch.rand(2, 7, 4)).shape
        torch.Size([2, 7, 5, 16])
    """

    def __init__(self, config: PredictorConfig, slot_dim: int, action_dim: int) -> None:
        super().__init__(config)
        c = config
        self.embed_slots = nn.Linear(slot_dim, c.dim)
        self.embed_action = nn.Linear(action_dim, c.dim) if action_dim else None
        sizes = (c.dim, c.heads, c.head_dim, c.mlp_dim, c.project_out)
        self.objects = nn.ModuleList(TransformerBlock(*sizes) for _ in range(c.layers))
        self.time = nn.ModuleList(TransformerBlock(*sizes) for _ in range(c.layers))
        self.norm = nn.LayerNorm(c.dim)
        self.head = nn.Linear(c.dim, slot_dim)
        self._start_still()

    def _predict(
        self, slots: Tensor, condition: Condition, code: Tensor, mask: Tensor | None, past: Layers | None
    ) -> tuple[Tensor, Layers]:
        b, s, n = slots.shape[:3]
        x = self.embed_slots(slots)
        if self.embed_action is not None:
            x = torch.cat((x, self.embed_action(torch.cat(condition, dim=-1)).unsqueeze(2)), dim=2)
        x, m = x + code, x.shape[2]
        if mask is not None and mask.dim() > 2:
            mask = mask.repeat_interleave(m, dim=0)
        kept: Layers = []
        for i, (objects, time) in enumerate(zip(self.objects, self.time, strict=True)):
            y, _ = objects(x.reshape(b * s, m, -1))
            y = y.view(b, s, m, -1).transpose(1, 2).reshape(b * m, s, -1)
            y, keys_values = time(y, mask, None if past is None else past[i])
            kept.append(keys_values)
            x = y.view(b, m, s, -1).transpose(1, 2)
        return self._output(x[:, :, :n], slots), kept
