"""`playslot plan` from end to end."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from commands import contents, smoke

from playslot_rl.config.compose import compose
from playslot_rl.config.planning import PLANNERS, PROPOSALS
from playslot_rl.errors import ConfigError

pytestmark = pytest.mark.integration

SMALL = (
    "env.max_steps=20",  # smoke's are too few for the expert
    "plan.horizon=3",
    "plan.candidates=4",
    "plan.iterations=1",
    "plan.elites=2",
    "plan.descents=1",
    "plan.near=0.01",
)


def test_a_table_of_everything_and_what_stands_behind_it(run: Path) -> None:
    shutil.rmtree(run / "evaluation")
    before = contents(run)
    done = smoke("plan", f"run={run}", "planner=cem", "proposal=all", "episodes=1", *SMALL)
    after = contents(run)
    assert {path: after[path] for path in before} == before
    assert {path.split("/")[0] for path in after.keys() - before.keys()} == {"planning"}
    page = (run / "planning" / "planning.md").read_text()
    assert page in done.out
    report = json.loads((run / "planning" / "planning.json").read_text())
    for goals in ("solved", "ahead"):
        part = report["goals"][goals]
        assert list(part["rows"]) == ["random", "policy", "cem", "cem-policy"]
        assert part["cost_along_solution"].keys() >= {"slots", "dynamics", "image", "model_error"}
        assert (run / "planning" / goals / "cost.png").read_bytes().startswith(b"\x89PNG")
        for name in ("cem", "cem-policy"):
            info = json.loads((run / "planning" / goals / name / "eval_info.json").read_text())
            assert info == part["rows"][name]
            assert info["seconds_per_decision"] > 0
            assert info["planning"]["horizon"] == 3
            assert len(info["per_episode"]) == info["episodes"] == len(info["seeds"])
            assert (run / "planning" / goals / name / "plan.png").read_bytes().startswith(b"\x89PNG")
        costs = [part["rows"]["cem-policy"][f"{whose}_cost_first"] for whose in ("plan", "proposal")]
        assert costs[0] <= costs[1] * (1 + 1e-5)  # equal but for rounding where the plan is the proposal
    again = smoke(
        "plan", f"run={run}", "planner=cem", "goals=ahead", "episodes=1", "evaluation.references=false", *SMALL
    )
    assert "random" not in again.out
    same = json.loads((run / "planning" / "planning.json").read_text())["goals"]["ahead"]["rows"]["cem"]
    first = report["goals"]["ahead"]["rows"]["cem"]
    assert (same["plan_cost"], same["per_episode"]) == (first["plan_cost"], first["per_episode"])


def test_short_keys_are_those_of_the_group() -> None:
    plan = compose(["planner=all", "proposal=none,policy", "goals=ahead"], "plan").plan
    assert (plan.planner, plan.proposal, plan.goals) == (PLANNERS, PROPOSALS, ("ahead",))
    assert compose(["planner=[mppi]"], "plan").plan.planner == ("mppi",)
    with pytest.raises(ConfigError, match="unknown key planner"):
        compose(["planner=cem"], "evaluate")
