"""cOCVP: slots of the next frame from past slots and latent actions (paper, section "Conditional Object-Centric
Prediction").

    S^_{t+1} = head(Transformer(Lin(S_{1:t}) + Lin(p_{1:t}) + Lin(v_{1:t}) + code(t)))

Shapes: slots (B, T, N, D), p and v (B, T, Z) (added to every slot) or (B, T, N, Z) (each to its slot) -> (B, T, N, D).
The mask is causal over frames and full within a frame.
"""

from __future__ import annotations

from torch import Tensor, nn

from playslot_rl.config import PredictorConfig
from playslot_rl.modules.predictors.predictor import AutoregressivePredictor, Condition, Layers
from playslot_rl.modules.transformer import TransformerBlock


class COCVP(AutoregressivePredictor):
    """Conditional object-centric video predictor.

    Example:
        >>> import torch
        >>> model = COCVP(PredictorConfig(), slot_dim=128, latent_dim=16)
        >>> z = torch.randn(2, 5, 16)
        >>> model.rollout(torch.randn(2, 1, 4, 128), z, z).shape
        torch.Size([2, 5, 4, 128])
    """

    def __init__(self, config: PredictorConfig, slot_dim: int, latent_dim: int) -> None:
        super().__init__(config)
        c = config
        self.embed_slots = nn.Linear(slot_dim, c.dim)
        self.embed_prototype = nn.Linear(latent_dim, c.dim)
        self.embed_variability = nn.Linear(latent_dim, c.dim)
        sizes = (c.dim, c.heads, c.head_dim, c.mlp_dim, c.project_out)
        self.blocks = nn.ModuleList(TransformerBlock(*sizes) for _ in range(c.layers))
        self.norm = nn.LayerNorm(c.dim)
        self.head = nn.Linear(c.dim, slot_dim)
        self._start_still()

    def _tokens(self, slots: Tensor, p: Tensor, v: Tensor, code: Tensor) -> Tensor:
        action = self.embed_prototype(p) + self.embed_variability(v)
        if p.dim() == 3:
            action = action.unsqueeze(2)
        tokens: Tensor = self.embed_slots(slots) + action + code
        return tokens.flatten(1, 2)

    def _predict(
        self, slots: Tensor, condition: Condition, code: Tensor, mask: Tensor | None, past: Layers | None
    ) -> tuple[Tensor, Layers]:
        p, v = condition
        x, n = self._tokens(slots, p, v, code), slots.shape[2]
        if mask is not None:
            mask = mask.repeat_interleave(n, dim=-2).repeat_interleave(n, dim=-1)
        kept: Layers = []
        for i, block in enumerate(self.blocks):
            x, keys_values = block(x, mask, None if past is None else past[i])
            kept.append(keys_values)
        return self._output(x, slots), kept
