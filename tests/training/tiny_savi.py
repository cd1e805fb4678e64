"""A SAVi whose step takes milliseconds."""

from __future__ import annotations

import torch

from playslot_rl.config import SAViConfig
from playslot_rl.modules.savi import SAVi


def tiny_savi(seed: int = 0, **changes: object) -> SAVi:
    """SAVi for frames of 32x32: N 3 slots of D 16, seeded weights, and `changes` of fields of `SAViConfig`."""
    values: dict[str, object] = {
        "n_slots": 3,
        "slot_dim": 16,
        "encoder_channels": (8, 8),
        "encoder_strides": (2, 2),
        "encoder": "strided",
        "token_dim": 12,
        "decoder": "pixel_shuffle",
        "decoder_channels": (8, 8),
        "corrector_mlp": 16,
        "transition_heads": 2,
        "transition_mlp": 16,
        "initial": "learned",
    }
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return SAVi(SAViConfig(**(values | changes)), image_size=32)  # type: ignore[arg-type]
