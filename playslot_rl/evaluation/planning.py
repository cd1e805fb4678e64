"""Planning measured: each way of acting on the same goals, and what the cost looks like along a true solution.

Shapes: T agent steps, H horizon, P things with a place, N slots, D slot width.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

from playslot_rl import keys
from playslot_rl.acting.actor import Actor, RandomActor, goal_slots
from playslot_rl.acting.agent import playslot_actor
from playslot_rl.acting.episodes import Moment, Outcome, run_episodes
from playslot_rl.acting.planners import build_planner, search_size
from playslot_rl.acting.planners.costs import GoalCost, goal_distance
from playslot_rl.acting.planning import PlanningActor
from playslot_rl.config import ExperimentConfig
from playslot_rl.config.planning import CostName, GoalName
from playslot_rl.evaluation.goals import Frames, GoalEpisode, GoalPool, Trace, distance
from playslot_rl.evaluation.intervals import wilson
from playslot_rl.evaluation.success import summary
from playslot_rl.frames import normalise, to_uint8
from playslot_rl.world_model import Agent, module_device

STRIDE: Final = 1
"""Episodes with a goal never start solved, so none is drawn anew."""


@dataclass
class Played:
    """Episodes towards goals, as one way of acting played them: outcomes, by the task's own measure, and traces, an
    episode each; `wall` seconds of wall clock. The lists are empty where nothing is planned: slots (H + 1, N, D) of
    each episode's first plan; costs, proposals and seconds of every decision, and of the first one of each episode.
    """

    outcomes: list[Outcome] = field(default_factory=list)
    traces: list[Trace] = field(default_factory=list)
    plans: list[Tensor] = field(default_factory=list)
    costs: list[float] = field(default_factory=list)
    proposals: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    first_costs: list[float] = field(default_factory=list)
    first_proposals: list[float] = field(default_factory=list)
    wall: float = 0.0


def steps_to_act(config: ExperimentConfig, goals: GoalName) -> int:
    """Agent steps that a row has to reach its goal."""
    if goals == "solved":
        return config.acting.max_steps
    return max(2, round(config.plan.budget / config.acting.frame_skip))


def ways_of_acting(
    config: ExperimentConfig, agent: Agent, protocol: GoalName, goals: Sequence[GoalEpisode]
) -> dict[str, Actor]:
    """The rows of a table: random actions and the latent policy (unless `evaluation.references` is false), then each
    planner with each proposal. A ConfigError for a planner that the world model cannot serve.
    """
    plan, size = config.plan, search_size(config.plan, protocol, config.acting.frame_skip)
    images = {goal.seed: goal.image for goal in goals}

    def image_of(seeds: Sequence[int]) -> Tensor:
        return torch.stack([images[seed] for seed in seeds]).to(module_device(agent.world_model))

    actors: dict[str, Actor] = {}
    if config.evaluation.references:
        actors["random"] = RandomActor(steps_to_act(config, protocol), config.acting.action_dim)
        actors["policy"] = playslot_actor(agent)
        actors["policy"].goals = image_of
    for name in plan.planner:
        planner = build_planner(name, plan, size, agent.world_model)
        for proposal in plan.proposal:
            row, policy = (name, False) if proposal == "none" else (f"{name}-{proposal}", True)
            actors[row] = PlanningActor(agent, planner, plan, size, image_of, policy, config.seed)
    return {name: actor.eval() for name, actor in actors.items()}


def play(
    pool: GoalPool,
    actor: Actor,
    goals: Sequence[GoalEpisode],
    protocol: GoalName,
    max_steps: int,
    every: int,
    draw: bool,
) -> Played:
    """Run one actor, in evaluation mode, towards each goal, for at most `max_steps`, planning anew `every` so many;
    `draw` also frames that it does not look at.

    With goals `solved` an episode ends where the task says that it is solved; with `ahead` it takes all its steps,
    since what counts is where things are.
    """
    pool.begin(goals, max_steps)
    played = Played()

    def look_on(moment: Moment) -> None:
        seen = moment.seen
        if seen is None or keys.PLAN_COST not in seen.keys() or moment.step % every:  # noqa: SIM118 (a tensordict)
            return
        costs, proposals, seconds = (
            seen.get(key).flatten().tolist() for key in (keys.PLAN_COST, keys.PROPOSAL_COST, keys.PLAN_SECONDS)
        )
        played.costs += costs
        played.proposals += proposals
        played.seconds += seconds
        if moment.step == 0:
            played.plans += list(seen.get(keys.PREDICTED_SLOTS).cpu())
            played.first_costs += costs
            played.first_proposals += proposals

    begin = time.perf_counter()
    seeds = [goal.seed for goal in goals]
    stop = protocol == "solved"
    played.outcomes = run_episodes(pool, actor, seeds, look_on, stop=stop, draw=draw, stride=STRIDE)
    played.wall = time.perf_counter() - begin
    played.traces = [pool.traces[seed] for seed in seeds]
    return played


def results(played: Played, goals: Sequence[GoalEpisode], near: float) -> dict[str, Any]:
    """What is reported of a way of acting.

    `success_rate`, `ci95` and `mean_steps_to_success` are by the task's own measure; by `state_success_rate` and
    `state_ci95` everything was within `near` metres of its place in the goal at some step. `state_distance`,
    `state_closest` and `state_distance_at_start` are metres, means over episodes at the end, at the closest step and at
    the start. Costs are means, with `_first` at the first decision; None where nothing is planned.
    """
    ways = [
        [distance(p, goal.places[-1]) for p in trace.places] for goal, trace in zip(goals, played.traces, strict=True)
    ]
    reached = sum(min(way) < near for way in ways)
    episodes = [
        {
            **asdict(outcome),
            "start": goal.start,
            "expert_steps": len(goal.frames) - 1,
            "state_distance": round(way[-1], 4),
            "state_closest": round(min(way), 4),
        }
        for outcome, goal, way in zip(played.outcomes, goals, ways, strict=True)
    ]
    return {
        **summary(played.outcomes),
        "state_success_rate": reached / len(ways),
        "state_ci95": list(wilson(reached, len(ways))),
        "state_distance": float(np.mean([way[-1] for way in ways])),
        "state_closest": float(np.mean([min(way) for way in ways])),
        "state_distance_at_start": float(np.mean([way[0] for way in ways])),
        "near_m": near,
        "seconds_per_decision": _mean(played.seconds),
        "decisions": len(played.seconds),
        "plan_cost": _mean(played.costs),
        "proposal_cost": _mean(played.proposals),
        "plan_cost_first": _mean(played.first_costs),
        "proposal_cost_first": _mean(played.first_proposals),
        "wall_seconds": round(played.wall, 2),
        "per_episode": episodes,
    }


def _mean(values: Sequence[float]) -> float | None:
    known = [value for value in values if math.isfinite(value)]
    return float(np.mean(known)) if known else None


@torch.no_grad()
def cost_along_solution(
    agent: Agent, goals: Sequence[GoalEpisode], looks: int, match: bool | None = None
) -> dict[str, Any]:
    """What each distance to the goal is along the expert's own way, frame by frame: is the goal a minimum, and does the
    way there lead downhill? `looks` and `match` are as when planning.

    Returns:
        For `slots`, `dynamics` and `image`: `curves` (each T + 1 values, start to goal), `goal_is_minimum` (share of
        the ways on which no frame before the goal is nearer to it), `downhill` (share of the steps that lower it) and
        `hill` (mean over ways of the highest value over that at the start; 1: it never rises above the start).
        `model_error`: mean squared slot error after the whole way, imagined under the latents that InvDyn infers on
        it; `moved`: that of standing still.
    """
    model, device = agent.world_model, module_device(agent.world_model)
    curves: dict[CostName, list[list[float]]] = {"slots": [], "dynamics": [], "image": []}
    errors, moved = [], []
    for goal in goals:
        frames = normalise(torch.from_numpy(goal.frames).movedim(-1, -3).to(device))
        slots = model.savi.parse(frames[None], goal.seed)[0]
        state = model.savi(frames[None, :1], generator=torch.Generator(device).manual_seed(goal.seed))[1]
        there = goal_slots(model.savi, state, goal.image[None].to(device), looks)[0]
        distances = {kind: goal_distance(agent, kind, there, goal.image.to(device), match) for kind in curves}
        for name, to_goal in distances.items():
            curves[name].append([round(value, 6) for value in to_goal(slots).tolist()])
        z = model.inverse_dynamics(slots[None]).z
        cost = GoalCost(model, slots[:1], z[0, :0], distances["slots"])
        errors.append(float((cost.imagine(z)[0, -1] - slots[-1]).square().mean()))
        moved.append(float((slots[0] - slots[-1]).square().mean()))
    found: dict[str, Any] = {name: shape(ways) for name, ways in curves.items()}
    return {**found, "model_error": float(np.mean(errors)), "moved": float(np.mean(moved))}


def shape(ways: list[list[float]]) -> dict[str, Any]:
    steps = [after < before for way in ways for before, after in itertools.pairwise(way)]
    return {
        "goal_is_minimum": float(np.mean([min(way) == way[-1] for way in ways])),
        "downhill": float(np.mean(steps)),
        "hill": float(np.mean([max(way) / max(way[0], 1e-12) for way in ways])),
        "curves": ways,
    }


def decoded_plan(agent: Agent, slots: Tensor) -> Frames:
    """The frames (H + 1, H, W, 3) that a plan's slots (H + 1, N, D) show."""
    device = module_device(agent.world_model)
    return to_uint8(agent.world_model.savi.decode(slots.to(device)).frames.detach())
