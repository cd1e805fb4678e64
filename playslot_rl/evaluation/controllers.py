"""The agent as a controller: closed loop (simulation) and open loop (imagination).

Shapes: E episodes in lock-step, n of them still running, T agent steps, N slots, D slot dim, Z latent-action dim,
A action dim, H W image height and width.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from playslot_rl import keys
from playslot_rl.evaluation.episodes import Actions, Frames, Task
from playslot_rl.world_model import Agent


def frames_to_tensor(frames: Frames, device: torch.device) -> Tensor:
    """(n, H, W, 3) uint8 [0, 255] -> (n, 3, H, W) float32 [0, 1]."""
    return torch.from_numpy(frames).to(device).movedim(-1, -3).float().div(255)


def device_of(module: torch.nn.Module) -> torch.device:
    """Device of a module's parameters."""
    return next(module.parameters()).device


class ClosedLoop:
    """Observe, parse with SAVi's recurrent state, choose, decode, act (paper, section "Learning behaviours").

    Args:
        agent: in evaluation mode.
        oracle: act by the slot oracle, which gives real actions, instead of latent policy and action decoder.

    Raises:
        ValueError: the agent has no oracle.
    """

    def __init__(self, agent: Agent, oracle: bool = False) -> None:
        if oracle and agent.oracle is None:
            raise ValueError("ClosedLoop: got an agent without a slot oracle, expected one trained with behaviour.oracle")
        self._agent = agent
        self._oracle = agent.oracle if oracle else None
        self._device = device_of(agent)
        self._state: Tensor | None = None
        self._generator = torch.Generator(self._device)

    def begin(self, frames: Frames, seeds: Sequence[int]) -> None:
        """Forget the last episodes; sampled initial slots are a function of the seeds."""
        self._state = None
        self._generator.manual_seed(seeds[0])

    @torch.no_grad()
    def act(self, step: int, running: Sequence[int], frames: Frames, tasks: Sequence[Task]) -> Actions:
        """Actions (n, A) in [-1, 1] for frames (n, H, W, 3)."""
        rows = torch.as_tensor(running, device=self._device)
        state = None if self._state is None else self._state[rows]
        pixels = frames_to_tensor(frames, self._device)[:, None]
        slots, after = self._agent.world_model.savi(pixels, state, generator=self._generator)
        if self._state is None:
            self._state = after
        else:
            self._state = self._state.index_copy(0, rows, after)
        actions: Actions = self._choose(slots[:, -1]).cpu().numpy()
        return actions

    def _choose(self, slots: Tensor) -> Tensor:
        """(n, N, D) -> (n, A)."""
        if self._oracle is not None:
            oracle_actions: Tensor = self._oracle(slots).clamp(-1, 1)
            return oracle_actions
        actions: Tensor = self._agent.action_decoder(self._agent.policy(slots))
        return actions


class Imagination(NamedTuple):
    """An imagined rollout.

    Attributes:
        slots: (E, T + 1, N, D); the first are parsed from the first frame, the others predicted.
        latents: (E, T, Z) latent actions of the policy.
        actions: (E, T, A) decoded actions in [-1, 1].
    """

    slots: Tensor
    latents: Tensor
    actions: Tensor


@torch.no_grad()
def imagine(agent: Agent, frames: Frames, steps: int, seed: int = 0) -> Imagination:
    """Unfold the policy in latent space from first frames: nothing is observed afterwards.

    Args:
        agent: in evaluation mode.
        frames: (E, H, W, 3) uint8 first frames.
        steps: T.
        seed: of sampled initial slots (SAVi with `initial: gaussian`).
    """
    from playslot_rl.imagination import ImaginationEnv
    from playslot_rl.world_model import latent_policy_module

    device = device_of(agent)
    generator = torch.Generator(device).manual_seed(seed)
    slots, _ = agent.world_model.savi(frames_to_tensor(frames, device)[:, None], generator=generator)
    env = ImaginationEnv(agent.world_model, batch_size=(len(frames),))
    start = env.reset_from_slots(slots[:, 0])
    rollout = env.rollout(steps, latent_policy_module(agent.policy), tensordict=start, auto_reset=False)
    latents = rollout[keys.LATENT_ACTION]
    unfolded = torch.cat([rollout[keys.SLOTS][:, :1], rollout["next", keys.SLOTS]], 1)
    return Imagination(unfolded, latents, agent.action_decoder(latents))


class OpenLoop:
    """Execute the actions of an imagined rollout; the frames that follow are never looked at.

    Args:
        agent: in evaluation mode.
        steps: agent steps to imagine.
    """

    def __init__(self, agent: Agent, steps: int) -> None:
        self._agent, self._steps = agent, steps
        self.imagined: list[Imagination] = []
        self._actions: Actions = np.zeros((0, steps, 0), np.float32)

    def begin(self, frames: Frames, seeds: Sequence[int]) -> None:
        """Imagine all episodes of the chunk in one batch; kept in `imagined` for pictures."""
        rollout = imagine(self._agent, frames, self._steps, seeds[0])
        self.imagined.append(rollout)
        self._actions = rollout.actions.cpu().numpy()

    def act(self, step: int, running: Sequence[int], frames: Frames, tasks: Sequence[Task]) -> Actions:
        """The step's actions (n, A) of the running episodes."""
        return self._actions[list(running), step]
