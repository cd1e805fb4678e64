"""What is timed of the networks: training steps, rollouts, games and searches, as the commands run them.

Shapes: B batch, T frames, N slots, D slot width.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from playslot_rl.config import (
    DynamicsStageConfig,
    EnvConfig,
    ExperimentConfig,
    OptimConfig,
    Precision,
    SlotsStageConfig,
)
from playslot_rl.config.compose import compose
from playslot_rl.modules.predictors.cocvp import COCVP
from playslot_rl.play.pictures import game
from playslot_rl.speed.steps import RandomStage, Step, precisions
from playslot_rl.speed.timing import in_turns
from playslot_rl.world_model import Agent, WorldModel, module_device

CPU = torch.device("cpu")


def _paper() -> ExperimentConfig:
    optim = OptimConfig(lr=1e-4)
    slots = SlotsStageConfig(clip_frames=4, batch_size=2, optim=optim)
    return ExperimentConfig(slots=slots, dynamics=DynamicsStageConfig(batch_size=2, optim=optim))


@dataclass(frozen=True)
class Sizes:
    """Sizes and repeats; the defaults are the paper's model, with batches small enough for two CPU cores.

    Attributes:
        decoded_frames: predicted frames that the dynamics step's extra row decodes.
        rollout: B, T, N.
        play_slots, play_steps: what a task has, and what fills the predictor's context.
        plan: candidates, iterations, steps of a plan, elites.
        parsed: how many episodes are parsed into slots.
        rounds: in which the variants of a case take turns.
    """

    config: ExperimentConfig = field(default_factory=_paper)
    decoded_frames: int = 2
    rollout: tuple[int, int, int] = (64, 15, 8)
    play_slots: int = 4
    play_steps: int = 30
    plan: tuple[int, int, int, int] = (64, 8, 16, 8)
    episodes: int = 40
    episode_frames: int = 21
    parsed: int = 8
    window: int = 14
    window_batch: int = 32
    rounds: int = 3


def quick_sizes() -> Sizes:
    """Sizes that show that everything runs; the figures mean nothing (`preset=smoke`, tests)."""
    small = compose(["preset=smoke", "dynamics.decoded_frames=0"])
    return Sizes(
        small, decoded_frames=1, rollout=(2, 5, 3), play_slots=3, play_steps=2, plan=(4, 1, 2, 2), episodes=3,
        episode_frames=8, parsed=2, window=4, window_batch=2, rounds=1,
    )  # fmt: skip


def savi_step(sizes: Sizes) -> dict[str, float]:
    """Seconds of SAVi's training step in each precision."""
    stages = {p: RandomStage(sizes.config, "slots", CPU, p) for p in precisions("cpu")}
    return in_turns({f"collapsed_{p}_allocator": stage.step() for p, stage in stages.items()}, sizes.rounds)


def dynamics_step(sizes: Sizes) -> dict[str, float]:
    """Seconds of the training step of InvDyn and cOCVP in the quicker precision, also with fewer decoded frames."""
    few = replace(sizes.config, dynamics=replace(sizes.config.dynamics, decoded_frames=sizes.decoded_frames))
    named = {"fast": sizes.config, f"fast_{sizes.decoded_frames}_decoded": few}
    return in_turns({name: RandomStage(c, "dynamics", CPU, "auto").step() for name, c in named.items()}, sizes.rounds)


def rollout(sizes: Sizes) -> dict[str, float]:
    """Seconds of a rollout from one seed frame."""
    return in_turns({"cached": rollout_step(sizes, COCVP.rollout)}, sizes.rounds)


def rollout_step(sizes: Sizes, way: Callable[[COCVP, Tensor, Tensor, Tensor], Tensor]) -> Step:
    """A rollout without gradients, by one of the predictor's two ways."""
    (batch, steps, slots), model = sizes.rollout, sizes.config.model
    dim, z = model.savi.slot_dim, model.inverse_dynamics.latent_dim
    predictor = COCVP(model.predictor, dim, z).eval()
    seed = torch.randn(batch, 1, slots, dim)
    p, v = (torch.randn(batch, steps, z) for _ in range(2))
    return torch.no_grad()(lambda: way(predictor, seed, p, v).square().mean())


def play_step(sizes: Sizes) -> dict[str, float]:
    """Seconds of an imagined frame: the shipped model as `playslot play` runs it, and one of the sizes in each
    precision."""
    from playslot_rl.runs import Run

    own = replace(sizes.config.model, savi=replace(sizes.config.model.savi, n_slots=sizes.play_slots))
    models = {"shipped": Run.open("pretrained").load_world_model()}
    for precision in precisions("cpu"):
        fresh = WorldModel(own, EnvConfig(image_size=sizes.config.env.image_size))
        models[f"paper_{precision}"] = prepared(fresh, precision)
    took = in_turns({name: game(model, sizes.play_steps) for name, model in models.items()}, sizes.rounds)
    return {name: value / sizes.play_steps for name, value in took.items()}


def prepared(model: WorldModel, precision: Precision) -> WorldModel:
    """A fresh model with a codebook, in a precision."""
    model.savi.precision = precision
    model.inverse_dynamics.split(torch.randn(64, model.inverse_dynamics.latent_dim, device=module_device(model)))
    return model


def plan_step(sizes: Sizes) -> dict[str, float]:
    """Seconds of a search towards a goal's slots with the shipped model."""
    from playslot_rl.runs import Run

    return in_turns({"own": plan_towards_goal(Run.open("pretrained").load_agent(), sizes)}, sizes.rounds)


def plan_towards_goal(agent: Agent, sizes: Sizes) -> Step:
    """A search from random slots to random ones."""
    from playslot_rl.acting.planners import CEMPlanner, Search, latent_statistics
    from playslot_rl.acting.planners.costs import GoalCost, SlotDistance

    device = module_device(agent)
    model, statistics = agent.world_model.eval().requires_grad_(False), latent_statistics(agent)
    candidates, iterations, horizon, elites = sizes.plan
    start, goal = torch.randn(2, *model.slot_shape).to(device)
    shape, generator = (horizon, *model.latent_shape), torch.Generator(device).manual_seed(0)
    past, none = (torch.empty(0, *of, device=device) for of in (model.latent_shape, shape))
    planner = CEMPlanner(candidates, iterations, elites)

    @torch.no_grad()
    def search() -> Tensor:
        cost = GoalCost(model, start[None], past, SlotDistance(goal))
        return planner(Search(cost, shape, statistics, none), generator).latents

    return search
