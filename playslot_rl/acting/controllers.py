"""The agent as a controller: closed loop (simulation) and open loop (imagination).

Shapes: E episodes in lock-step, n of them still running, T agent steps, N slots, D slot dim, Z latent-action dim,
A action dim, H W image height and width.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from playslot_rl import keys
from playslot_rl.acting.episodes import Actions, Frames, Moment
from playslot_rl.world_model import Agent, dynamics_module, latent_policy_module, module_device


def frames_to_tensor(frames: Frames, device: torch.device) -> Tensor:
    """(n, H, W, 3) uint8 [0, 255] -> (n, 3, H, W) float32 [0, 1]."""
    return torch.from_numpy(frames).to(device).movedim(-1, -3).float().div(255)


class ClosedLoop:
    """Observe, parse with SAVi's recurrent state, choose, decode, act (paper, section "Learning behaviours").

    Args:
        agent: in evaluation mode.
        oracle: act by the slot oracle, which gives real actions, instead of latent policy and action decoder.

    Raises:
        ValueError: the agent has no oracle.
    """

    sees_frames = True

    def __init__(self, agent: Agent, oracle: bool = False) -> None:
        if oracle and agent.oracle is None:
            raise ValueError(
                "ClosedLoop: got an agent without a slot oracle, expected one trained with behaviour.oracle"
            )
        self._agent = agent
        self._oracle = agent.oracle if oracle else None
        self._device = module_device(agent)
        self._state: Tensor | None = None
        self._generator = torch.Generator(self._device)

    def begin(self, moment: Moment) -> None:
        """Forget the last episodes; sampled initial slots are a function of the seeds."""
        self._state = None
        self._generator.manual_seed(moment.seeds[0])

    @torch.no_grad()
    def act(self, moment: Moment) -> Actions:
        """Actions (n, A) in [-1, 1] of the running episodes."""
        rows = torch.as_tensor(moment.running, device=self._device)
        state = None if self._state is None else self._state[rows]
        pixels = frames_to_tensor(moment.frames, self._device)[:, None]
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
    device = module_device(agent)
    generator = torch.Generator(device).manual_seed(seed)
    slots, _ = agent.world_model.savi(frames_to_tensor(frames, device)[:, None], generator=generator)
    return unfold(agent, slots[:, 0], steps)


@torch.no_grad()
def unfold(agent: Agent, slots: Tensor, steps: int) -> Imagination:
    """Imagine from given slots (E, N, D), by the step of the imagination environment (`dynamics_module`).

    Equal to `ImaginationEnv.rollout(policy)` (tested), without the copies an environment keeps of every step.
    """
    model, context = agent.world_model, agent.world_model.config.predictor.context
    e = len(slots)
    history = slots.new_zeros(e, context, *slots.shape[1:])
    history[:, -1] = slots
    state = TensorDict(
        {
            keys.SLOTS: slots,
            keys.SLOT_HISTORY: history,
            keys.ACTION_HISTORY: slots.new_zeros(e, context, *model.latent_shape),
            keys.HISTORY_LENGTH: torch.ones(e, 1, dtype=torch.long, device=slots.device),
        },
        batch_size=[e],
    )
    policy = latent_policy_module(agent.policy)
    step = dynamics_module(model.inverse_dynamics, model.predictor)
    unfolded, latents = [slots], []
    for _ in range(steps):
        state = step(policy(state))
        latents.append(state[keys.LATENT_ACTION])
        unfolded.append(state[keys.SLOTS])
    z = torch.stack(latents, 1)
    return Imagination(torch.stack(unfolded, 1), z, agent.action_decoder(z))


class OpenLoop:
    """Execute the actions of an imagined rollout; the frames that follow are never looked at.

    Args:
        agent: in evaluation mode.
        steps: agent steps to imagine.
    """

    sees_frames = False

    def __init__(self, agent: Agent, steps: int) -> None:
        self._agent, self._steps = agent, steps
        self.imagined: list[Imagination] = []
        self._actions: Actions = np.zeros((0, steps, 0), np.float32)

    def begin(self, moment: Moment) -> None:
        """Imagine all episodes of the chunk in one batch; kept in `imagined` for pictures."""
        rollout = imagine(self._agent, moment.frames, self._steps, moment.seeds[0])
        self.imagined.append(rollout)
        self._actions = rollout.actions.cpu().numpy()

    def act(self, moment: Moment) -> Actions:
        """The step's actions (n, A) of the running episodes."""
        return self._actions[list(moment.running), moment.step]
