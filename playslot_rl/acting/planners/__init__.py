"""Planners: searches for the latent actions that lead to a goal image, behind one protocol, and the choice among them.

`playslot_rl.acting.planning` acts by them in the simulator; `torchrl_planning` is the way in for TorchRL's own.
"""

from __future__ import annotations

from playslot_rl.acting.planners.cem import CEMPlanner
from playslot_rl.acting.planners.gradient import GradientPlanner
from playslot_rl.acting.planners.mppi import MPPIPlanner
from playslot_rl.acting.planners.planner import Cost, Plan, Planner, Search, latent_statistics, shifted
from playslot_rl.acting.planners.prototypes import PrototypePlanner
from playslot_rl.acting.planners.size import SearchSize
from playslot_rl.config.planning import PlanConfig, PlannerName
from playslot_rl.errors import ConfigError
from playslot_rl.world_model import WorldModel

__all__ = [
    "CEMPlanner",
    "Cost",
    "GradientPlanner",
    "MPPIPlanner",
    "Plan",
    "Planner",
    "PrototypePlanner",
    "Search",
    "build_planner",
    "latent_statistics",
    "shifted",
]


def build_planner(name: PlannerName, plan: PlanConfig, size: SearchSize, world_model: WorldModel) -> Planner:
    """A planner by its name; a ConfigError for `prototypes` with a world model that has none."""
    c, n = plan, size
    if name == "gradient":
        return GradientPlanner(c.descents, n.iterations, c.learning_rate, c.spread, c.start_spread, c.correlation)
    if name == "prototypes":
        if not world_model.inverse_dynamics.n_prototypes:
            mode = world_model.config.inverse_dynamics.mode
            raise ConfigError(f"planner=prototypes: got a world model of mode {mode}, which has none; use planner=cem")
        prototypes = world_model.inverse_dynamics.prototypes
        return PrototypePlanner(prototypes, n.candidates, n.iterations, n.elites, c.floor)
    noise = (c.spread, c.start_spread, c.floor)
    if name == "mppi":
        return MPPIPlanner(n.candidates, n.iterations, c.temperature, *noise, correlation=c.correlation)
    return CEMPlanner(n.candidates, n.iterations, n.elites, *noise, c.correlation)
