"""`playslot plan` from end to end."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from commands import contents, refused, smoke

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


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("planner=icem", r"plan\.planner: got 'icem', expected one of cem, mppi, gradient, prototypes"),
        ("proposal=oracle", r"plan\.proposal: got 'oracle', expected one of none, policy"),
        ("planner=cem,cem", "planner: got .* expected each one once"),
        ("planner=", "planner: got .* expected at least one"),
        ("plan.horizon=0", r"plan\.horizon: got 0, expected at least 1 agent step"),
        ("plan.goals=future", r"plan\.goals: got 'future', expected one of solved, ahead"),
        ("plan.floor=0", r"plan\.floor: got 0\.0, expected a number above 0"),
        ("plan.correlation=1.0", r"plan\.correlation: got 1\.0, expected 0 to under 1"),
    ],
)
def test_bad_settings_are_refused(shared_run: Path, argument: str, message: str) -> None:
    refused("plan", f"run={shared_run}", argument, message=message, code=2)


def test_settings_that_do_not_fit_are_refused(shared_run: Path) -> None:
    refused("plan", f"run={shared_run}", "plan.elites=5", "plan.candidates=4", message=r"plan\.elites", code=2)
    refused(
        "plan", f"run={shared_run}", "plan.every=30", message=r"plan\.every: got 30, expected at most plan\.horizon"
    )


def test_a_run_without_a_policy_is_refused(world: Path) -> None:
    before = contents(world)
    for proposal in ("none", "policy"):
        refused(
            "plan",
            f"run={world}",
            f"proposal={proposal}",
            message="got no policy/checkpoint, expected a trained policy",
        )
    assert contents(world) == before


def test_an_environment_without_a_simulator_is_refused(run: Path) -> None:
    config = json.loads((run / "config.json").read_text())
    config["env"]["name"] = "grid_shapes"
    (run / "config.json").write_text(json.dumps(config))
    refused("plan", f"run={run}", message="env=grid_shapes: got an environment without a simulator, expected one of")


def test_nothing_to_plan_in_is_refused(tmp_path: Path) -> None:
    refused("plan", message="run: got nothing, expected")
    refused("plan", f"run={tmp_path / 'no'}", message="got no .*config.json", code=2)
    out = f"out={tmp_path / 'new'}"
    refused("plan", "run=pretrained/grid_shapes", out, message="no pretrained world model for env=grid_shapes")
    refused("plan", "run=pretrained", message="out: got nothing with run=pretrained")
    assert list(tmp_path.iterdir()) == []
