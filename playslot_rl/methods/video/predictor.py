"""What the video comparison asks of a model (paper, section 4.1): frames after some seed frames.

Shapes: B batch, T frames of a clip, S seed frames, H W image height and width.
"""

from __future__ import annotations

from typing import Protocol

from torch import Tensor


class VideoPredictor(Protocol):
    """Predicts frames.

    Attributes:
        infers: whether it reads latents off the true future (SVG-LP, CADDY, PlaySlot); one that does not (SlotFormer,
            OCVP-Seq) sees nothing but the seed.
    """

    infers: bool

    def predict(self, frames: Tensor, seed: int, donors: Tensor | None = None) -> Tensor:
        """Frames (B, T - S, 3, H, W), float, about [0, 1], after the seed, each from its own predictions.

        What a frame past the seed shows enters through the latents alone, and with `donors` not even there.

        Args:
            frames: clips (B, T, 3, H, W), float [0, 1].
            seed: S, at least 1 and less than T, else a ValueError.
            donors: clips of the same shape from whose future the latents are inferred instead; whether these steer the
                prediction shows in the difference. Not looked at where nothing is inferred.
        """


def check_clip(frames: Tensor, seed: int) -> None:
    """Refuse clips that have no frame past the seed."""
    if not 1 <= seed < frames.shape[1]:
        raise ValueError(f"clip: got {frames.shape[1]} frames with {seed} seed frames, expected more, and a seed")
