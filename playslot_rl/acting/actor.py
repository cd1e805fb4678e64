"""What every method of a comparison is at test time: an actor, and the controller that lets it act.

    (a_t, m_{t+1}) = actor(o_t, m_t),    m_0 = actor.initial(seeds)

Shapes: E episodes in lock-step, n of them still running, A action dim, H W image height and width. The memory m is a
TensorDict of batch size [n], empty for actors without one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase

from playslot_rl import keys
from playslot_rl.acting.episodes import Actions, Moment


class Actor(Protocol):
    """Frame to real action.

    Attributes:
        module: reads PIXELS uint8 (n, 3, H, W) and the memory's keys, writes ACTION (n, A) in [-1, 1] and the memory's
            keys anew. In evaluation mode it is a function of its inputs.
    """

    module: TensorDictModuleBase

    def initial(self, seeds: Sequence[int]) -> TensorDict:
        """The memory of new episodes, batch size [len(seeds)]; whatever is drawn depends on the seeds alone."""


class ActorController:
    """An actor in closed loop, as `playslot_rl.acting.episodes.Controller`.

    Args:
        actor: put into evaluation mode by the caller.
        device: where it computes.
    """

    sees_frames = True

    def __init__(self, actor: Actor, device: torch.device) -> None:
        self._actor, self._device = actor, device
        self._memory: TensorDictBase = TensorDict({}, [0])

    def begin(self, moment: Moment) -> None:
        """Forget the last episodes."""
        self._memory = self._actor.initial(moment.seeds).to(self._device)

    @torch.no_grad()
    def act(self, moment: Moment) -> Actions:
        """Actions (n, A) in [-1, 1] of the running episodes."""
        rows = torch.as_tensor(moment.running, device=self._device)
        memory = self._memory[rows]
        pixels = torch.from_numpy(moment.frames).to(self._device).movedim(-1, -3)
        out = self._actor.module(memory.clone().set(keys.PIXELS, pixels))
        for key in self._memory.keys(include_nested=True, leaves_only=True):
            self._memory.set_at_(key, out.get(key), rows)
        actions: Actions = out.get(keys.ACTION).clamp(-1, 1).cpu().numpy()
        return actions
