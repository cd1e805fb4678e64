"""Actors on a frozen SAVi: its recurrent state is the memory, a head turns the slots of a frame into an action."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase, TensorDictSequential

from playslot_rl import keys
from playslot_rl.modules.savi import SAVi
from playslot_rl.world_model import frame_parser_module, module_device


class SlotActor:
    """Frame to slots (memory: SLOT_STATE and SLOT_AGE), slots to action. An `Actor`.

    Note: initial slots that are sampled (SAVi with `initial: gaussian`) come from a generator that `initial` seeds with
    the first episode's seed, as `playslot_rl.acting.controllers.ClosedLoop` does; learned ones draw nothing.

    Args:
        savi: in evaluation mode.
        heads: modules that together read SLOTS (n, N, D) and write ACTION (n, A).
    """

    def __init__(self, savi: SAVi, *heads: TensorDictModuleBase) -> None:
        self._shape = (savi.config.n_slots, savi.config.slot_dim)
        self._device = module_device(savi)
        self._generator = torch.Generator(self._device)
        self.module: TensorDictModuleBase = TensorDictSequential(frame_parser_module(savi, self._generator), *heads)

    def initial(self, seeds: Sequence[int]) -> TensorDict:
        """No frame seen: SLOT_STATE (n, N, D) zeros, not read while SLOT_AGE (n, 1) is 0."""
        self._generator.manual_seed(seeds[0])
        n, device = len(seeds), self._device
        return TensorDict(
            {
                keys.SLOT_STATE: torch.zeros(n, *self._shape, device=device),
                keys.SLOT_AGE: torch.zeros(n, 1, dtype=torch.long, device=device),
            },
            [n],
        )


class ReactiveActor:
    """Frame to action without memory. An `Actor`.

    Args:
        module: reads PIXELS uint8 (n, 3, H, W), writes ACTION (n, A).
    """

    def __init__(self, module: TensorDictModuleBase) -> None:
        self.module = module

    def initial(self, seeds: Sequence[int]) -> TensorDict:
        """Nothing to remember."""
        return TensorDict({}, [len(seeds)])
