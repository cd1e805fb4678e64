"""Starting SAVi from the weights of another, to train it on other videos (fine-tuning)."""

from __future__ import annotations

import torch

from playslot_rl.errors import CheckpointError
from playslot_rl.modules.savi import SAVi

INITIAL_SLOTS = "initializer.mean"


def warm_start(savi: SAVi, source: SAVi, where: str) -> None:
    """Copy weights in place. With another number of learned initial slots the first ones are copied and the rest kept.

    Note: the paper trains each SAVi from scratch. Slot Attention first fits what all frames share and only then takes
    scenes apart; where objects are small and of any colour, that plateau outlasts what a CPU can pay for, and a SAVi
    that has learned elsewhere to take scenes apart leaves it early.

    Args:
        savi: what will be trained.
        source: what it starts from; all sizes but the number of slots must be equal.
        where: its name, for the error.

    Raises:
        CheckpointError: sizes differ.
    """
    own, other = savi.state_dict(), source.state_dict()
    shapes = [
        (
            name,
            tuple(other[name].shape) if name in other else "nothing",
            tuple(own[name].shape) if name in own else "nothing",
        )
        for name in sorted({*own, *other} - {INITIAL_SLOTS})
    ]
    for name, got, expected in shapes:
        if got != expected:
            raise CheckpointError(
                f"slots.start_from={where}: got {name} of {got}, expected {expected}: give model.savi.* its sizes"
            )
    with torch.no_grad():
        rows = min(len(own[INITIAL_SLOTS]), len(other[INITIAL_SLOTS]))
        initial = own[INITIAL_SLOTS].clone()
        initial[:rows] = other[INITIAL_SLOTS][:rows]
    savi.load_state_dict({**other, INITIAL_SLOTS: initial})
