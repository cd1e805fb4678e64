"""Acting by planning: parse, search for latent actions, execute the first few through the action decoder, plan again.

Shapes: n episodes side by side, H horizon, C frames of history, N slots, D slot width, Z latent-action width, A action
width, H W image height and width.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from playslot_rl import keys
from playslot_rl.acting.actor import Actor, OfEpisodes, put_goals, put_rows
from playslot_rl.acting.agent import imagine
from playslot_rl.acting.planners import Cost, Planner, Search, SearchSize, latent_statistics, shifted
from playslot_rl.acting.planners.costs import GoalCost, NearProposal, goal_distance
from playslot_rl.config.planning import PlanConfig
from playslot_rl.seeds.draws import step_generator
from playslot_rl.world_model import Agent, action_decoder_module, frame_parser_module


class PlanningActor(Actor):
    """Plans every few steps towards goal images, and executes the plan's latent actions by the action decoder.

    A plan begins where the last one ends: shifted by what was executed, the mean latent action at its end. With
    `policy` the latent policy's imagined rollout from the present slots is a plan to begin with too. Candidates are
    drawn by `seed`, the episode's seed and the step, so that episodes side by side do not touch each other.

    The plan, its imagined slots PREDICTED_SLOTS (n, H + 1, N, D), its cost and the seconds it took stay in the memory,
    for who looks on.
    """

    def __init__(
        self,
        agent: Agent,
        planner: Planner,
        plan: PlanConfig,
        size: SearchSize,
        goals: OfEpisodes,
        policy: bool = False,
        seed: int = 0,
    ) -> None:
        model = agent.world_model
        slots, seen = model.slot_shape, min(plan.history, model.config.predictor.context)
        zeros = {
            keys.SLOT_STATE: slots,
            keys.SLOT_HISTORY: (seen, *slots),
            keys.GOAL_SLOTS: slots,
            keys.PLANNED_LATENTS: (size.horizon, *model.latent_shape),
            keys.PREDICTED_SLOTS: (size.horizon + 1, *slots),
            **dict.fromkeys((keys.PLAN_COST, keys.PROPOSAL_COST, keys.PLAN_SECONDS), (1,)),
        }
        super().__init__((*zeros, keys.SLOT_AGE, keys.STEP_COUNT, keys.EPISODE_SEED), goal=True)
        self.agent, self.planner, self.config, self.size = agent, planner, plan, size
        self.goals, self.policy, self.seed, self.frames_seen, self._zeros = goals, policy, seed, seen, zeros
        self.whitening = latent_statistics(agent)
        self.parser = frame_parser_module(model.savi)
        self.decoder = action_decoder_module(agent.action_decoder)

    def reset(self, seeds: Sequence[int]) -> TensorDict:
        memory, n = super().reset(seeds), len(seeds)
        self.parser.module.generator = torch.Generator(self.device).manual_seed(seeds[0])
        for key, shape in self._zeros.items():
            memory[key] = torch.zeros(n, *shape)
        for key in (keys.SLOT_AGE, keys.STEP_COUNT):
            memory[key] = torch.zeros(n, 1, dtype=torch.long)
        memory[keys.EPISODE_SEED] = torch.tensor(seeds)[:, None]
        return memory

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Parse, plan where a plan is due, and take the plan's present step."""
        self.parser(tensordict)
        slots, step = tensordict.get(keys.SLOTS), tensordict.get(keys.STEP_COUNT)
        history = torch.cat([tensordict.get(keys.SLOT_HISTORY)[:, 1:], slots[:, None]], 1)
        tensordict.set(keys.SLOT_HISTORY, history)
        steps = step.flatten().tolist()
        if 0 in steps:
            put_goals(self.agent.world_model.savi, tensordict, step.squeeze(-1) == 0, self.config.looks)
        for row, at in enumerate(steps):
            if at % self.size.every == 0:
                self._plan(tensordict, row, at)
        now = (step.squeeze(-1) % self.size.every).clamp(max=self.size.horizon - 1)
        rows = torch.arange(len(step), device=step.device)
        tensordict.set(keys.LATENT_ACTION, tensordict.get(keys.PLANNED_LATENTS)[rows, now])
        return self.decoder(tensordict).set(keys.STEP_COUNT, step + 1)

    def _plan(self, tensordict: TensorDictBase, row: int, step: int) -> None:
        """Renew the plan of one episode in the tensordict."""
        begin, seed = time.perf_counter(), int(tensordict.get(keys.EPISODE_SEED)[row])
        cost = self._cost(tensordict, row, step)
        proposal = self._proposal(cost.slots[-1], tensordict.get(keys.GOAL_SLOTS)[row])
        starts = proposal
        if step:
            last = tensordict.get(keys.PLANNED_LATENTS)[row]
            starts = torch.cat([proposal, shifted(last, self.size.every, self.whitening.mean)[None]])
        shape = (self.size.horizon, *self.agent.world_model.latent_shape)
        priced: Cost = cost
        if self.size.prior and len(proposal):
            priced = NearProposal(cost, proposal[0], self.whitening, self.size.prior)
        search = Search(priced, shape, self.whitening, starts, self.config.bound, self.config.seconds)
        plan = self.planner(search, step_generator(seed, step, f"plan-{self.seed}", self.device))
        future = torch.cat([cost.slots[-1:], cost.imagine(plan.latents[None])[0]])
        offered = float(cost(proposal)[0]) if len(proposal) else float("nan")
        found = {
            keys.PLANNED_LATENTS: plan.latents,
            keys.PREDICTED_SLOTS: future,
            keys.PLAN_COST: torch.tensor([plan.cost]),
            keys.PROPOSAL_COST: torch.tensor([offered]),
            keys.PLAN_SECONDS: torch.tensor([time.perf_counter() - begin]),
        }
        put_rows(tensordict, row, found)

    def _cost(self, tensordict: TensorDictBase, row: int, step: int) -> GoalCost:
        model = self.agent.world_model
        seen = tensordict.get(keys.SLOT_HISTORY)[row, -min(step + 1, self.frames_seen) :]
        past = model.inverse_dynamics(seen[None]).z[0] if len(seen) > 1 else seen.new_empty(0, *model.latent_shape)
        goal, image = tensordict.get(keys.GOAL_SLOTS)[row], tensordict.get(keys.GOAL_PIXELS)[row]
        distance = goal_distance(self.agent, self.config.cost, goal, image, self.config.match)
        return GoalCost(model, seen, past, distance, self.config.along)

    def _proposal(self, slots: Tensor, goal: Tensor) -> Tensor:
        """The policy's plan from slots (N, D) to those of the goal: latent actions (1, H, Z), or none (0, H, Z)."""
        if not self.policy:
            return slots.new_empty(0, self.size.horizon, *self.agent.world_model.latent_shape)
        return policy_plan(self.agent, slots, self.size.horizon, goal)


def policy_plan(agent: Agent, slots: Tensor, horizon: int, goal: Tensor | None = None) -> Tensor:
    """What the latent policy would do from slots (N, D), imagined, to those of a goal where it is shown one: latent
    actions (1, H, Z).
    """
    first = {keys.SLOTS: slots[None], **({} if goal is None else {keys.GOAL_SLOTS: goal[None]})}
    return imagine(agent, TensorDict(first, [1]), horizon).latents
