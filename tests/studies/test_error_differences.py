"""Without a simulator methods differ by the error of their actions, on pairs of the same seed and episode."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jobs_on_disk import comparison

from playslot_rl.config.methods import METHODS
from playslot_rl.evaluation.actions import Errors, scores
from playslot_rl.studies.success.errors import summarise_errors
from playslot_rl.studies.success.figure import success_figure
from playslot_rl.studies.success.page import success_page
from playslot_rl.studies.success.summary import differences
from playslot_rl.visualization.charts import LIGHT
from playslot_rl.visualization.document import to_markdown

ACTIONS = np.array([10.0, 30.0, 20.0, 20.0])
"""Of each of four episodes."""
CLONED = np.array([[2.0, 3.0, 4.0, 3.0], [2.5, 3.0, 4.5, 3.0]])
"""Mean errors of the reference's two seeds, episode by episode."""


def rows(method: str, errors: Any) -> list[dict[str, Any]]:
    """A finished job for each seed, whose mean error is that of its actions."""
    found = []
    for seed, own in enumerate(np.asarray(errors)):
        mean = float((own * ACTIONS).sum() / ACTIONS.sum())
        values = {"mae": mean, "rmse": 2 * mean, "r2": 0.5}
        found.append({
            "name": f"{method}-d4-l2-s{seed}", "method": method, "title": METHODS[method].title, "protocol": "actions",
            "demos": 4, "labels": 2, "world": 0, "seed": seed, "status": "done", "error": None, "labelled_demos": 2,
            "success_rate": None, "outcomes": None, "episodes": len(own), "ci95": {"mae": None, "r2": None}, **values,
            "references": {"constant": values, "previous": values},
            "per_episode": {"rows": ACTIONS.tolist(), "mae": own.tolist(), "rmse": own.tolist()},
            "agent_steps": None, "env_steps": None, "samples": None, "parameters": None, "pretraining": None,
            "train_seconds": 1.0, "evaluation_seconds": 1.0, "curve": None,
        })  # fmt: skip
    return found


def test_a_difference_is_that_of_the_errors_of_all_actions() -> None:
    [found] = differences([*rows("playslot", CLONED), *rows("lapo", CLONED + 1)], "playslot")
    assert (found["method"], found["protocol"], found["labels"], found["seeds"]) == ("lapo", "actions", 2, [0, 1])
    assert found["difference"] == pytest.approx(1.0)
    assert found["ci95"] == pytest.approx((1.0, 1.0)), "however many actions an episode has, each is worse by 1"


def test_an_interval_is_that_of_evaluate() -> None:
    [found] = summarise_errors(rows("lapo", CLONED[:1]))
    own = Errors(*((ACTIONS * CLONED[0] ** power)[:, None] for power in (1, 2)), ACTIONS)
    of_evaluate = scores(own, own, np.ones(1))
    assert found["mae"] == pytest.approx(of_evaluate["mae"])
    assert found["ci95"] == pytest.approx(of_evaluate["ci95"]["mae"])


def test_episodes_that_are_hard_for_both_do_not_widen_it() -> None:
    hard = np.array([[1.0, 9.0, 1.0, 9.0], [1.0, 9.0, 1.0, 9.0]])
    own = summarise_errors(rows("lapo", hard + 0.5))[0]["ci95"]
    [found] = differences([*rows("playslot", hard), *rows("lapo", hard + 0.5)], "playslot")
    low, high = found["ci95"]
    assert high - low < 0.2 * (own[1] - own[0])


@pytest.mark.parametrize(("more", "better"), [(-1.0, True), (1.0, False), (np.array([1.0, -1, 1, -1]), None)])
def test_the_lower_error_is_better(more: Any, better: bool | None) -> None:
    [found] = differences([*rows("playslot", CLONED), *rows("lapo", CLONED + more)], "playslot")
    assert found["better"] is better
    assert found["leaves_out_0"] is (better is not None)


def test_a_seed_that_one_of_them_lacks_makes_no_pair() -> None:
    [found] = differences([*rows("playslot", CLONED), *rows("lapo", [CLONED[0] - 2])], "playslot")
    assert found["seeds"] == [0]
    assert found["difference"] == pytest.approx(-2.0)


def test_what_is_of_fewer_seeds_says_so(tmp_path: Path) -> None:
    jobs = [*rows("playslot", CLONED), *rows("lapo", CLONED)]
    jobs[2]["references"] = {name: {"mae": 9.0, "rmse": 9.0, "r2": 0.0} for name in ("constant", "previous")}
    measured = ("mae", "rmse", "r2", "references", "per_episode")
    jobs[3] = {key: value for key, value in jobs[3].items() if key not in measured} | {"status": "waiting"}
    result = {**comparison(tmp_path, []), "rows": jobs, "summary": summarise_errors(jobs), "labels": [2], "episodes": 4}
    result |= {"measure": "actions", "held_out": 4, "differences": differences(jobs, "playslot")}
    page = to_markdown(success_page(result))
    cells = [line.split("|")[2].strip() for line in page.splitlines() if line.startswith(("| LAPO |", "| (action"))]
    assert cells[0].endswith("; 1 of 2 seeds")
    assert cells[1].startswith("3.22"), "of the method that has most seeds"
    assert cells[2].endswith("(of 1 seed)")
    (axes,) = success_figure(result, LIGHT).axes
    assert {"mean labelled action", "action of the step before"} <= {line.get_label() for line in axes.lines}


def test_the_page_says_which_side_is_better(tmp_path: Path) -> None:
    jobs = [*rows("playslot", CLONED), *rows("lapo", CLONED - 1)]
    result = {**comparison(tmp_path, []), "rows": jobs, "summary": summarise_errors(jobs), "labels": [2], "episodes": 4}
    result |= {"measure": "actions", "held_out": 4, "differences": differences(jobs, "playslot")}
    page = to_markdown(success_page(result))
    assert "Error less that of PlaySlot (below 0 is better than PlaySlot, above 0 is worse), on pairs of the" in page
    [line] = [line for line in page.splitlines() if line.startswith("| LAPO | **")]
    assert line.split("|")[2].strip().startswith("**−1 (−")
    assert "Points" not in page
