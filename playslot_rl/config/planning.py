"""Config of `playslot plan` (the group `plan` of the experiment's config)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, Literal, get_args

from playslot_rl.config.plain import check
from playslot_rl.config.roles import Checked, above_zero, at_least, below_one, between

PlannerName = Literal["cem", "mppi", "gradient", "prototypes"]
ProposalName = Literal["none", "policy"]
CostName = Literal["slots", "dynamics", "image"]
GoalName = Literal["solved", "ahead"]
PLANNERS: Final[tuple[PlannerName, ...]] = get_args(PlannerName)
PROPOSALS: Final[tuple[ProposalName, ...]] = get_args(ProposalName)
GOALS: Final[tuple[GoalName, ...]] = get_args(GoalName)

_POSITIVE = above_zero("a number above 0")


@dataclass(frozen=True)
class PlanConfig(Checked):
    """How `playslot plan` plans. On its command line `planner=` and `proposal=` go without the group's name, and take
    one name, several with commas, or `all`.

    Where a key is None the goals decide: `solved` and `ahead` each have their own setting
    (`playslot_rl.acting.planners`).

    Attributes:
        planner: `cem`, `mppi`, `gradient` (through the differentiable rollout), `prototypes` (categorical CEM); a row
            of the table each.
        proposal: `none` plans alone, `policy` begins with the latent policy's imagined rollout.
        goals: `solved`: the frame in which the expert solves the held-out episode, from its first frame; `ahead`:
            stable-worldmodel's protocol, the frame 25 environment steps ahead in the expert's episode.
        cost: distance of `slots`, of scene `dynamics` (InvDyn's means), or of the decoded `image`.
        match: match slots with the goal's by the Hungarian algorithm; None where SAVi's initial slots are sampled.
        along: weight of the mean distance on the way, beside that at the horizon's end, 0 to 1.
        horizon: agent steps that are imagined.
        every: agent steps that are executed before the next plan.
        candidates: plans imagined in an iteration.
        iterations: of the search.
        elites: best candidates that it goes on from.
        descents: candidates of the gradient planner, which descend side by side.
        seconds: wall clock of each decision in place of `iterations`; 0: iterations decide, and runs repeat.
        spread: first standard deviation, in units of the training latents'.
        start_spread: the same round a plan to begin with.
        floor: least standard deviation.
        bound: the search stays within so many standard deviations.
        correlation: of the noise of neighbouring steps.
        temperature: of MPPI, in units of the deviation of the costs.
        learning_rate: of the gradient planner.
        prior: with `proposal=policy`, what straying from the policy's plan costs, in whitened coordinates; 0: nothing.
        history: frames of the past that the predictor sees, at most its context.
        looks: times that SAVi is shown the goal image.
        ahead: environment steps to the goal, with goals `ahead`.
        budget: environment steps to act in, with goals `ahead`.
        near: metres within which everything has to be of its place in the goal, for success by state.
        pictures: episodes that are drawn.
    """

    group = "plan."
    planner: tuple[PlannerName, ...] = ("cem",)
    proposal: tuple[ProposalName, ...] = ("none",)
    goals: tuple[GoalName, ...] = ("solved", "ahead")
    cost: CostName = "dynamics"
    match: bool | None = None
    along: float = field(default=0.1, metadata=between(0, 1, "0 to 1"))
    horizon: int | None = field(default=None, metadata=at_least(1, "at least 1 agent step"))
    every: int | None = field(default=None, metadata=at_least(1, "at least 1 agent step"))
    candidates: int | None = field(default=None, metadata=at_least(2, "at least 2"))
    iterations: int | None = field(default=None, metadata=at_least(1, "at least 1"))
    elites: int | None = field(default=None, metadata=at_least(1, "at least 1"))
    descents: int = field(default=4, metadata=at_least(1, "at least 1"))
    seconds: float = field(default=0.0, metadata=at_least(0, "0 (iterations decide) or more"))
    spread: float = field(default=1.0, metadata=_POSITIVE)
    start_spread: float = field(default=0.2, metadata=_POSITIVE)
    floor: float = field(default=0.05, metadata=_POSITIVE)
    bound: float = field(default=3.0, metadata=_POSITIVE)
    correlation: float = field(default=0.5, metadata=below_one("0 to under 1"))
    temperature: float = field(default=0.2, metadata=_POSITIVE)
    learning_rate: float = field(default=0.1, metadata=_POSITIVE)
    prior: float | None = field(default=None, metadata=at_least(0, "0 or more"))
    history: int = field(default=1, metadata=at_least(1, "at least 1 frame", 1000))
    looks: int = field(default=2, metadata=at_least(1, "at least 1", 1000))
    ahead: int = field(default=25, metadata=at_least(1, "at least 1 environment step"))
    budget: int = field(default=50, metadata=at_least(1, "at least 1 environment step"))
    near: float = field(default=0.05, metadata=_POSITIVE)
    pictures: int = field(default=3, metadata=at_least(0, "0 or more"))

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, values in (("planner", self.planner), ("proposal", self.proposal), ("plan.goals", self.goals)):
            check(len(values) > 0, name, values, "at least one")
            check(len(set(values)) == len(values), name, values, "each one once")
        if self.elites is not None and self.candidates is not None:
            check(
                self.elites <= self.candidates, "plan.elites", self.elites, f"at most the {self.candidates} candidates"
            )
        if self.every is not None and self.horizon is not None:
            check(self.every <= self.horizon, "plan.every", self.every, f"at most plan.horizon={self.horizon}")
