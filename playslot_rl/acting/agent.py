"""The agent as an actor: closed loop (simulation), open loop (imagination, or the expert's videos), and its slot
oracle.

Shapes: E episodes, T agent steps, N slots, D slot width, Z latent-action width, A action width, H W image size.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from playslot_rl import keys
from playslot_rl.acting.actor import Actor, ExpertActor, PlannedActor, SlotActor, goal_slots, put_rows
from playslot_rl.acting.belief import BeliefActor
from playslot_rl.acting.episodes import Moment, TaskPool, record, run_episodes
from playslot_rl.acting.imagination import ImaginationEnv
from playslot_rl.config.planning import PlanConfig
from playslot_rl.frames import normalise
from playslot_rl.modules.policy import told_keys
from playslot_rl.world_model import Agent, action_decoder_module, latent_policy_module, observed_keys, oracle_module


def playslot_actor(agent: Agent) -> SlotActor:
    """Parse with SAVi's recurrent state, choose a latent action, decode it (paper, section "Learning behaviours")."""
    if agent.policy.gain < 1:
        return BeliefActor(agent)
    heads = (latent_policy_module(agent.policy), action_decoder_module(agent.action_decoder))
    return SlotActor(agent.world_model.savi, *heads, policy=agent.policy)


def oracle_actor(agent: Agent) -> SlotActor:
    """The slot oracle beside the agent, which gives real actions; a ValueError where there is none."""
    if agent.oracle is None:
        raise ValueError("oracle_actor: got an agent without a slot oracle, expected one trained with behaviour.oracle")
    return SlotActor(agent.world_model.savi, oracle_module(agent.oracle), policy=agent.oracle)


class Imagination(NamedTuple):
    """An imagined rollout: slots (E, T + 1, N, D), the policy's latents (E, T, Z), decoded actions (E, T, A) in [-1,
    1].
    """

    slots: Tensor
    latents: Tensor
    actions: Tensor


@torch.no_grad()
def imagine(agent: Agent, first: TensorDictBase, steps: int, generator: torch.Generator | None = None) -> Imagination:
    """Unfold the policy for T steps in latent space: nothing is observed after `first`, SLOTS (E, N, D) or PIXELS
    (E, 3, H, W) on the agent's device, and TASK (E, 1) or GOAL_SLOTS (E, N, D) where the policy is told.

    The latents are decoded alone: a decoder that reads slots learned from those that it sees when it acts, and imagined
    ones mislead it (docs/notebook/labels.md).
    """
    env = ImaginationEnv(agent.world_model, first.batch_size, generator=generator)
    state, told = env.reset(first), [first.get(key) for key in told_keys(agent.policy)]
    slots, latents = [state[keys.SLOTS]], list[Tensor]()
    # Not by `env.rollout`, which asks the device after each step whether an episode is over.
    for _ in range(steps):
        latents.append(agent.policy(slots[-1], *told))
        state = env.step_mdp(env.step(state.set(keys.LATENT_ACTION, latents[-1])))
        slots.append(state[keys.SLOTS])
    z = torch.stack(latents, 1)
    return Imagination(torch.stack(slots, 1), z, agent.action_decoder(z))


class ImaginationActor(PlannedActor):
    """Executes the actions of a rollout of T imagined steps; the frames that follow the first are never looked at.

    The rollout's slots stay in the memory, PREDICTED_SLOTS (n, T + 1, N, D), for pictures.
    """

    looks = "first"

    def __init__(self, agent: Agent, steps: int) -> None:
        width, policy = agent.world_model.env.action_dim, agent.policy
        super().__init__(steps, width, (keys.PREDICTED_SLOTS,), (keys.PIXELS,), policy.tasks, policy.goal)
        self.agent = agent
        self._generator: torch.Generator | None = None

    def reset(self, seeds: Sequence[int]) -> TensorDict:
        """Nothing imagined yet; initial slots that are sampled depend on the first seed."""
        self._generator = torch.Generator(self.device).manual_seed(seeds[0])
        memory = super().reset(seeds)
        shape = (len(seeds), self.steps + 1, *self.agent.world_model.slot_shape)
        memory[keys.PREDICTED_SLOTS] = torch.zeros(shape)
        return memory

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Imagine the whole episode at its first frame; then the step's action."""
        fresh = tensordict.get(keys.STEP_COUNT).squeeze(-1) == 0
        if bool(fresh.any()):
            imagined = imagine(self.agent, self._shown(tensordict[fresh]), self.steps, self._generator)
            found = {keys.PLANNED_ACTIONS: imagined.actions, keys.PREDICTED_SLOTS: imagined.slots}
            put_rows(tensordict, fresh, found)
        return super().forward(tensordict)

    def _shown(self, first: TensorDictBase) -> TensorDictBase:
        """What a rollout begins with."""
        if not self.shown_goals:
            return first.select(*observed_keys(self.agent.policy, keys.PIXELS))
        savi = self.agent.world_model.savi
        slots, state = savi(normalise(first[keys.PIXELS])[:, None], generator=self._generator)
        goal = goal_slots(savi, state, first[keys.GOAL_PIXELS], PlanConfig.looks)
        return TensorDict({keys.SLOTS: slots[:, 0], keys.GOAL_SLOTS: goal}, first.batch_size)


def perform(pool: TaskPool, seeds: Sequence[int]) -> tuple[Tensor, Tensor]:
    """Film the scripted expert in episodes, none of which starts solved, to their last step: frames (E, T + 1, 3, H, W)
    uint8 [0, 255] and actions (E, T, A) in [-1, 1].
    """
    actions = torch.zeros(len(seeds), pool.env.max_steps, pool.env.action_dim)

    def note(moment: Moment) -> None:
        if moment.seen is not None:
            actions[list(moment.episodes), moment.step] = moment.seen[keys.ACTION].float().cpu()

    frames, _ = record(pool, ExpertActor(), seeds, note)
    return torch.from_numpy(frames).movedim(-1, -3), actions.clamp(-1, 1)


def show_goals(actor: Actor | None, stage: TaskPool) -> None:
    """Have an actor that is shown goals, and has none, reach those in which the scripted expert ends the same
    episodes; it plays them on a stage of its own, while the actor's environments wait at their first frames.
    """
    if actor is not None and actor.shown_goals and actor.goals is None:
        actor.goals = partial(ends, stage)


def ends(pool: TaskPool, seeds: Sequence[int]) -> Tensor:
    """The frames (E, 3, H, W) uint8 [0, 255] in which the scripted expert's episodes end; no others are drawn."""
    last = np.zeros((len(seeds), pool.env.image_size, pool.env.image_size, 3), np.uint8)

    def note(moment: Moment) -> None:
        if moment.step == pool.env.max_steps:
            last[moment.episodes] = moment.frames
        for task in pool.take(len(moment.episodes)):
            task.draw_steps = moment.step == pool.env.max_steps - 1

    run_episodes(pool, ExpertActor(), seeds, note, stop=False, draw=False)
    return torch.from_numpy(last).movedim(-1, -3)


class ReplayActor(PlannedActor):
    """Executes what the latents of the expert's own videos decode to, decoded alone as in imagination, without looking.

        S_0..S_T = SAVi(x_0..x_T),    z_t = InvDyn(S_t, S_{t+1}),    a_t = D_a(z_t)

    Beside imagination, whose latents come from the policy on predicted slots, everything but the decoder is the truth
    here: what fails is lost between a motion that was seen and the actions that made it.
    """

    def __init__(self, agent: Agent, performed: Callable[[Sequence[int]], tuple[Tensor, Tensor]]) -> None:
        env = agent.world_model.env
        super().__init__(env.max_steps, env.action_dim)
        self.agent, self.performed = agent, performed

    @torch.no_grad()
    def reset(self, seeds: Sequence[int]) -> TensorDict:
        """Plan whole episodes; initial slots that are sampled depend on the first seed."""
        memory, model = super().reset(seeds), self.agent.world_model
        frames, actions = (part.to(self.device) for part in self.performed(seeds))
        slots = model.savi.parse(normalise(frames), seeds[0])
        memory[keys.PLANNED_ACTIONS] = self.agent.action_decoder(model.inverse_dynamics(slots, actions).z)
        return memory
