"""The action decoder: a_t = D_a(z_t), a three-layer MLP (paper, appendix A.4), or a_t = D_a(z_t, S_t).

Shapes: latent actions (..., Z), slots (..., N, D) -> real actions (..., A) in [-1, 1]; what a robot takes instead of
them, `action_range` says.

Note: a final tanh keeps the output inside the action space; the paper does not name one. Inputs are standardised by the
mean and scale of the training latents: their scale is free (about 0.07 here), and a decoder on raw ones underfits. With
`whiten` they are whitened instead.

Note: the paper's decoder reads z_t alone. A latent action is a change of the image: the depth of a motion hardly shows
in it, and the same change asks for different actions in different places. With slots, their summary by the [ACT]
transformer of the policy, made small, is put beside z_t; it does not depend on the order of the slots. That is a second
MLP: the one on z_t alone stays, for where there are no slots (those predicted in imagination are a little off), and for
where it learned to read them from too few labels to be trusted (`trusts_slots`). Both are trained on every row; in some
the summary is replaced by zeros, so that no action hangs on the slots alone.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from playslot_rl.config import ActionDecoderConfig
from playslot_rl.modules.action_range import ActionRange
from playslot_rl.modules.transformer import SlotTokenEncoder, chosen_slots
from playslot_rl.modules.whitening import Whitening
from playslot_rl.runtime.shares import own_noise

SAME = 1e-6
"""Standard deviation up to which numbers count as the same."""


class ActionDecoder(nn.Module):
    """Real action from a latent action.

    Args:
        slot_dim: D of the slots that it reads beside z where `config.reads_slots`.

    Attributes:
        action_range: what its actions are in the robot's units.
    """

    mean: Tensor
    scale: Tensor
    trusts_slots: Tensor

    def __init__(
        self,
        config: ActionDecoderConfig,
        latent_dim: int,
        action_dim: int,
        slot_dim: int = 0,
    ) -> None:
        super().__init__()
        h, width, heads = config.hidden_dim, config.state_dim, config.state_heads
        self.whitening = Whitening(latent_dim) if config.whiten else None
        if not config.whiten:
            self.register_buffer("mean", torch.zeros(latent_dim))
            self.register_buffer("scale", torch.ones(latent_dim))
        self.layers = _mlp(latent_dim, h, action_dim)
        self.action_range = ActionRange(action_dim)
        self.encoder: SlotTokenEncoder | None = None
        if config.reads_slots:
            self.register_buffer("trusts_slots", torch.tensor(True))
            self.dropout, self.slots = config.state_dropout, config.slots
            self.encoder = SlotTokenEncoder(slot_dim, width, config.state_layers, heads, width // heads, 2 * width)
            self.seeing = _mlp(latent_dim + width, h, action_dim)

    @property
    def reads_slots(self) -> bool:
        """Whether `forward` wants slots."""
        return self.encoder is not None

    @property
    def acts_on_slots(self) -> bool:
        """Whether it reads slots and has learned enough from them to be trusted: without, it acts on z alone."""
        return self.reads_slots and bool(self.trusts_slots)

    @torch.no_grad()
    def standardise(self, z: Tensor) -> None:
        """Take mean and scale, or the whitening, from latent actions (M, Z).

        A number that is the same in all of them keeps its scale: divided by next to nothing, one that differs later
        would drown the others.
        """
        if self.whitening is not None:
            self.whitening.fit(z)
            return
        self.mean.copy_(z.mean(dim=0))
        spread = z.std(dim=0)
        self.scale.copy_(torch.where(spread > SAME, spread, 1.0))

    def forward(self, z: Tensor, slots: Tensor | None = None) -> Tensor:
        """Latent actions (..., Z), and slots (..., N, D) if it reads them and there are some, to actions (..., A)."""
        inputs = (z - self.mean) / self.scale if self.whitening is None else self.whitening(z)
        if self.encoder is None or slots is None or not (self.training or self.acts_on_slots):
            return self.action_range.pinned(torch.tanh(self.layers(inputs)))
        state = self.encoder(chosen_slots(slots, self.slots))
        if self.training and self.dropout:
            device = state.device  # the draw may be kept, and is not to keep the state
            drawn = own_noise((*state.shape[:-1], 1), lambda shape: torch.rand(shape, device=device))
            state = state * (drawn >= self.dropout)
        return self.action_range.pinned(torch.tanh(self.seeing(torch.cat((inputs, state), dim=-1))))


def _mlp(width: int, hidden: int, out: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(width, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, out)
    )
