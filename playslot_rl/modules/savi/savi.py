"""SAVi: frames to slots and back (paper, section "Object-Centric Representation Learning").

    S_t = correct(h_t, S_t^init),   S_{t+1}^init = transition(S_t),   o^_t = sum_n softmax_N(m_n) * rgb_n

Shapes: frames (B, T, 3, H, W) float in [0, 1]; slots (B, T, N, D). The slots handed on are the corrected ones.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from playslot_rl.config import Precision, SAViConfig
from playslot_rl.modules.savi.corrector import SlotAttention
from playslot_rl.modules.savi.decoder import BroadcastDecoder, PixelShuffleDecoder
from playslot_rl.modules.savi.encoder import SAViEncoder
from playslot_rl.modules.savi.initializer import SlotInitializer
from playslot_rl.modules.savi.transition import SlotTransition
from playslot_rl.runtime.precision import in_bf16


class Decoded(NamedTuple):
    """Rendered slots: frames (..., 3, H, W), rgb (..., N, 3, H, W), masks (..., N, 1, H, W) that sum to one over N."""

    frames: Tensor
    rgb: Tensor
    masks: Tensor


class SAVi(nn.Module):
    """Encoder, initialiser, corrector, transition and decoder.

    Args:
        config: sizes.
        image_size: side of the square frames.

    Attributes:
        compiled: the methods that `compile` is about: most of the arithmetic, and no random numbers.

    Example:
        >>> savi = SAVi(SAViConfig(n_slots=3), image_size=32)
        >>> slots, state = savi(torch.rand(2, 4, 3, 32, 32))
        >>> slots.shape, savi.decode(slots).frames.shape
        (torch.Size([2, 4, 3, 128]), torch.Size([2, 4, 3, 32, 32]))
    """

    compiled = ("features", "rendered")

    def __init__(self, config: SAViConfig, image_size: int) -> None:
        super().__init__()
        self.config, self.image_size = config, image_size
        self.precision: Precision = "fp32"
        c = config
        self.encoder = SAViEncoder(image_size, c.encoder_channels, c.encoder_strides, c.token_dim)
        self.initializer = SlotInitializer(c.n_slots, c.slot_dim, c.initial)
        self.corrector = SlotAttention(c.slot_dim, c.token_dim, c.corrector_mlp)
        self.transition = SlotTransition(c.slot_dim, c.transition_heads, c.transition_mlp)
        self.decoder: nn.Module = (
            BroadcastDecoder(image_size, c.slot_dim, c.decoder_channels, c.collapse)
            if c.decoder == "broadcast"
            else PixelShuffleDecoder(
                image_size, c.slot_dim, c.decoder_channels, c.decoder_position == "learned", c.decoder_start
            )
        )
        self.apply(_initialise)
        if c.transition_start == "identity":
            self.transition.start_as_identity()

    def forward(
        self,
        frames: Tensor,
        state: Tensor | None = None,
        generator: torch.Generator | None = None,
        initial: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Parse a clip.

        Args:
            frames: (B, T, 3, H, W) float in [0, 1].
            state: (B, N, D) returned by the previous call of the same episode; None at its first frame.
            generator: draws the initial slots of the `gaussian` initialiser.
            initial: slots (B, N, D) to begin the first frame with, where they are drawn already.

        Returns:
            Slots (B, T, N, D), and the state to go on from.
        """
        b, t = frames.shape[:2]
        keys, values = (
            x.unflatten(0, (b, t)).unbind(1) for x in self.features(frames.flatten(0, 1), self._bf16(frames))
        )
        first = state is None
        current = state if state is not None else initial
        current = self.initializer(b, generator) if current is None else current
        slots = []
        for i in range(t):
            iterations = self.config.first_iterations if first and i == 0 else self.config.iterations
            corrected = self.corrector(keys[i], values[i], current, iterations)
            slots.append(corrected)
            current = self.transition(corrected)
        return torch.stack(slots, dim=1), current

    def parse(self, frames: Tensor, seed: int = 0) -> Tensor:
        """Slots (B, T, N, D) of whole clips (B, T, 3, H, W); initial slots that are drawn are the seed's."""
        slots: Tensor = self(frames, generator=torch.Generator(frames.device).manual_seed(seed))[0]
        return slots

    def _bf16(self, inputs: Tensor) -> bool:
        return in_bf16(inputs.device.type, self.precision)

    def features(self, frames: Tensor, bf16: bool) -> tuple[Tensor, Tensor]:
        """Keys and values (M, L, D) of frames (M, 3, H, W); of bf16 on a GPU, where it is on."""
        device = frames.device.type
        surrounded = torch.autocast(device, torch.bfloat16, enabled=bf16)
        if device == "cpu":
            return self.corrector.keys_values(self.encoder(frames, surrounded))
        with surrounded:
            return self.corrector.keys_values(self.encoder(frames))

    def decode(self, slots: Tensor) -> Decoded:
        """Render slots (..., N, D)."""
        return Decoded(*self.rendered(slots, self._bf16(slots)))

    def rendered(self, slots: Tensor, bf16: bool) -> tuple[Tensor, Tensor, Tensor]:
        """What `Decoded` names, of slots (..., N, D)."""
        lead = slots.shape[:-1]
        with torch.autocast(slots.device.type, torch.bfloat16, enabled=bf16):
            out = self.decoder(slots.reshape(-1, slots.shape[-1]))
        out = out.float()
        out = out.reshape(*lead, *out.shape[1:])
        rgb, logits = out.split((3, 1), dim=-3)  # its backward is one copy, a slice's are zeros and a sum
        masks = torch.softmax(logits, dim=-4)
        return (rgb * masks).sum(dim=-4), rgb, masks


def _initialise(module: nn.Module) -> None:
    if isinstance(module, (nn.Linear, nn.Conv2d)):
        nn.init.xavier_uniform_(module.weight)
        if module.bias is not None:
            nn.init.zeros_(module.bias)
    elif isinstance(module, nn.GRUCell):
        nn.init.xavier_uniform_(module.weight_ih)
        nn.init.orthogonal_(module.weight_hh)
        nn.init.zeros_(module.bias_ih)
        nn.init.zeros_(module.bias_hh)
