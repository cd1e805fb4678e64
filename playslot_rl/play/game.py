"""A game without a browser: each step is predicted, decoded and encoded as what the page sends."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from playslot_rl.play.pictures import encode, strip, with_masks
from playslot_rl.play.session import PlaySession
from playslot_rl.play.starts import Start
from playslot_rl.world_model import WorldModel


def game(model: WorldModel, steps: int) -> Callable[[], Tensor]:
    """What plays one from its start, prototype after prototype; it returns the mean square of the last slots."""
    session, side = PlaySession(model), model.env.image_size
    first = Start("", np.zeros((side, side, 3), np.uint8), torch.randn(1, *model.slot_shape))

    @torch.no_grad()
    def play() -> Tensor:
        session.begin(first)
        for number in range(steps):
            session.press(number % len(session.prototypes), 1.0)
            look = session.look()
            encode(look.frame)
            encode(with_masks(look))
            encode(strip(look, session, None, 4))
        return session.slots.square().mean()

    return play
