"""SAVi's transition: one pre-norm transformer block over the slots of a frame (paper, appendix A.1).

S_{t+1}^init = Block(S_t)        slots (B, N, D) -> (B, N, D), no output projection, since heads * head_dim = D
"""

from __future__ import annotations

from torch import Tensor, nn

from playslot_rl.modules.transformer import TransformerBlock


class SlotTransition(nn.Module):
    """The slots that the corrector starts from at the next frame.

    Args:
        slot_dim: D.
        heads: attention heads, of width D / heads.
        mlp_dim: hidden width of the MLP.
    """

    def __init__(self, slot_dim: int, heads: int, mlp_dim: int) -> None:
        super().__init__()
        self.block = TransformerBlock(slot_dim, heads, slot_dim // heads, mlp_dim, project_out=False)

    def start_as_identity(self) -> None:
        """Silence what the block adds: its values and the last layer of its MLP start at zero."""
        last = self.block.mlp[-1]
        assert isinstance(last, nn.Linear)
        for weight in (self.block.to_v.weight, last.weight, last.bias):
            nn.init.zeros_(weight)

    def forward(self, slots: Tensor) -> Tensor:
        """Slots (B, N, D) to slots (B, N, D)."""
        out: Tensor = self.block(slots)[0]
        return out
