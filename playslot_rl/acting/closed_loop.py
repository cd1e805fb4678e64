"""One actor acting in episodes side by side, one call an agent step: it remembers, and forgets when told to.

The episode loop, `PlaySlot.act` and LeRobot's policy all act through it.

Shapes: B episodes, n of them still running, A action width, H W image height and width.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from playslot_rl import keys
from playslot_rl.acting.actor import Actor
from playslot_rl.errors import ConfigError
from playslot_rl.frames import to_uint8


class ClosedLoop:
    """An actor in evaluation mode, with its memory.

    `act` takes frames of `image_size`, 0 for as they come, and with `resize` resizes others by area averaging as in
    training, where it would refuse them. `seed` is that of episodes that begin without one.
    """

    def __init__(self, actor: Actor, image_size: int = 0, resize: bool = False, seed: int = 0) -> None:
        self.actor, self._side, self._resize, self._seed = actor, image_size, resize, seed
        self._memory: TensorDictBase | None = None

    @property
    def begun(self) -> bool:
        """Whether episodes run, which have been told what to do."""
        return self._memory is not None

    def reset(self, seeds: Sequence[int] | None = None) -> None:
        """Begin episodes with these seeds; None forgets, and the next frames begin as many episodes as they are."""
        self._memory = None if seeds is None else self.actor.reset(seeds)

    @torch.no_grad()
    def step(self, observation: TensorDictBase, rows: Sequence[int] | None = None) -> TensorDictBase:
        """See the present observation, batch size [n], of episodes `rows` (all if None) that have begun, and choose:
        what the actor writes, batch size [n], is ACTION (n, A), its memory, and whatever it found on the way.
        """
        memory = self._memory
        if memory is None:
            if self.actor.tasks and self.actor.tells is None:
                raise ConfigError(
                    "act: got a policy of several tasks, expected to be told which: PlaySlot.reset(task=...), or "
                    "reset(seeds), first"
                )
            self.reset([self._seed] * len(observation))
            return self.step(observation, rows)
        some = rows is not None and len(rows) < len(memory)
        index = torch.as_tensor(rows if some else [], dtype=torch.long, device=self.actor.device)
        seen: TensorDictBase = self.actor((memory[index] if some else memory.copy()).update(observation))
        for key in self.actor.memory_keys:
            after = seen.get(key)
            memory.set(key, memory.get(key).index_copy(0, index, after) if some else after)
        return seen

    def act(self, frames: Tensor, name: str = "frames") -> Tensor:
        """Actions (B, A) in [-1, 1] for the present frames (B, 3, H, W), float in [0, 1] or uint8 [0, 255], of all
        episodes; rows keep their place until `reset`. `actor.executed` gives them in the robot's units. A ValueError
        for another shape, or another number of episodes than at the last call.
        """
        pixels = self._fitted(frames, name).to(self.actor.device)
        if self._memory is not None and len(self._memory) != len(pixels):
            raise ValueError(
                f"{name}: got {len(pixels)} episodes, expected {len(self._memory)} as at the last step: call reset() "
                "before new episodes"
            )
        # As frames of a camera lie in memory: convolutions of another layout differ in the last digit.
        pixels = pixels.contiguous(memory_format=torch.channels_last)
        actions: Tensor = self.step(TensorDict({keys.PIXELS: pixels}, [len(pixels)])).get(keys.ACTION)
        return actions.clamp(-1, 1)

    def _fitted(self, frames: Tensor, name: str) -> Tensor:
        side = self._side or frames.shape[-1]
        if frames.ndim != 4 or frames.shape[1] != 3:
            other = ", or another height and width" if self._resize else ""
            raise ValueError(f"{name}: got shape {tuple(frames.shape)}, expected (batch, 3, {side}, {side}){other}")
        if tuple(frames.shape[2:]) == (side, side):
            return frames
        if not self._resize:
            raise ValueError(
                f"{name}: got frames of {frames.shape[2]}x{frames.shape[3]}, expected {side}x{side}, with which the "
                "policy was trained: record at that size"
            )
        return resized(frames, side)


def resized(frames: Tensor, side: int) -> Tensor:
    """(..., 3, H, W) to uint8 (..., 3, side, side), by what the frames of the training went through, to the last digit
    (floats are bytes divided by 255, as LeRobot gives them).
    """
    from playslot_rl.data.frames import resize_frames

    pictures = to_uint8(frames)
    small = resize_frames(pictures.reshape(-1, *pictures.shape[-3:]), side)
    return torch.from_numpy(small).movedim(-1, -3).reshape(*frames.shape[:-2], side, side)
