"""The policy as others call it: a batch of frames in, a batch of actions out, one call an agent step.

    s_t, m_{t+1} = SAVi(o_t, m_t),    a_t = D_a(f_pi(s_t))     (paper, section "Learning behaviours")

The memory m is SAVi's recurrent state, kept between calls and forgotten by `reset`.

Shapes: B episodes in lock-step, N slots, D slot width, A action width, H W image height and width.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from playslot_rl.world_model import module_device, normalise

if TYPE_CHECKING:
    from playslot_rl.world_model import Agent


class FramePolicy:
    """An agent that remembers its episodes.

    Args:
        agent: in evaluation mode.
        resize: resize frames of another size, by area averaging as in training, instead of refusing them.
        seed: of sampled initial slots (SAVi with `initial: gaussian`); every `reset` starts from it anew.
    """

    def __init__(self, agent: Agent, resize: bool = False, seed: int = 0) -> None:
        self._agent, self._resize, self._seed = agent, resize, seed
        self._state: Tensor | None = None
        self._generator: torch.Generator | None = None

    def reset(self) -> None:
        """Forget the episodes: the next frames are first ones."""
        self._state, self._generator = None, None

    @torch.no_grad()
    def act(self, frames: Tensor, name: str = "frames") -> Tensor:
        """Actions for the present frames of the running episodes.

        Args:
            frames: (B, 3, H, W), float in [0, 1] or uint8 [0, 255]; rows keep their place until `reset`.
            name: of the frames, for messages.

        Returns:
            (B, A) in [-1, 1], on the agent's device.

        Raises:
            ValueError: another shape, or another number of episodes than at the last call.
        """
        device = module_device(self._agent)
        pixels = self._fitted(frames, name).to(device)
        if self._state is not None and len(self._state) != len(pixels):
            raise ValueError(
                f"{name}: got {len(pixels)} episodes, expected {len(self._state)} as at the last step: call reset() "
                "before new episodes"
            )
        if self._generator is None:
            self._generator = torch.Generator(device).manual_seed(self._seed)
        savi = self._agent.world_model.savi
        slots, self._state = savi(normalise(pixels)[:, None], self._state, generator=self._generator)
        actions: Tensor = self._agent.action_decoder(self._agent.policy(slots[:, 0]))
        return actions.clamp(-1, 1)

    def _fitted(self, frames: Tensor, name: str) -> Tensor:
        """Frames of the model's size."""
        side = self._agent.world_model.env.image_size
        if frames.ndim != 4 or frames.shape[1] != 3:
            raise ValueError(f"{name}: got shape {tuple(frames.shape)}, expected (batch, 3, {side}, {side})")
        if tuple(frames.shape[2:]) == (side, side):
            return frames
        if not self._resize:
            raise ValueError(
                f"{name}: got frames of {frames.shape[2]}x{frames.shape[3]}, expected {side}x{side}, with which the "
                "policy was trained: record at that size"
            )
        return _resized(frames, side)


def _resized(frames: Tensor, side: int) -> Tensor:
    """(B, 3, H, W) to uint8 (B, 3, side, side), by what the frames of the training went through."""
    from playslot_rl.data.frame_cache import resize_frames

    bytes_ = frames if frames.dtype == torch.uint8 else frames.mul(255).round().clamp(0, 255).byte()
    small = resize_frames(bytes_.movedim(1, -1).cpu().numpy(), side)
    return torch.from_numpy(small).movedim(-1, 1)
