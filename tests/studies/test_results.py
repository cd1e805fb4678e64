"""Rows, their summary over seeds, the page and the plot."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
from jobs_on_disk import comparison, finish

from playslot_rl.config.compose import compose
from playslot_rl.config.methods import METHODS
from playslot_rl.evaluation.intervals import wilson
from playslot_rl.evaluation.success import task_facts
from playslot_rl.recipes import compare_job
from playslot_rl.runs import Run
from playslot_rl.storage.atomic import write_json
from playslot_rl.studies.launch import Status, read_status, write_status
from playslot_rl.studies.study import count_parameters
from playslot_rl.studies.success.figure import success_figure
from playslot_rl.studies.success.jobs import SuccessJob, success_config, success_record
from playslot_rl.studies.success.measure import SuccessMeasure, job_rows
from playslot_rl.studies.success.page import cell, success_page
from playslot_rl.studies.success.summary import summarise
from playslot_rl.visualization.charts import LIGHT, figure_bytes
from playslot_rl.visualization.document import to_markdown


def _of(result: dict[str, Any], method: str, protocol: str = "simulation", demos: int | None = 10) -> dict[str, Any]:
    rows = [r for r in result["summary"] if (r["method"], r["protocol"], r["demos"]) == (method, protocol, demos)]
    assert len(rows) == 1
    return dict(rows[0])


def test_seeds_are_pooled_and_their_range_is_kept(ended: dict[str, Any]) -> None:
    row = _of(ended, "playslot")
    assert row["success_rate"] == pytest.approx(0.7)
    assert row["ci95"][0] < wilson(7, 10)[0]
    assert row["ci95"][1] > wilson(7, 10)[1], "two seeds that differ say more than the episodes of one"
    assert (row["lowest"], row["highest"], row["seeds"], row["episodes"]) == (0.6, 0.8, [0, 1], 20)
    assert (row["worlds"], row["runs"]) == ([0], 2)
    assert _of(ended, "playslot", "imagination")["success_rate"] == pytest.approx(0.2)


def test_a_failed_job_is_a_row_and_no_number(ended: dict[str, Any]) -> None:
    assert [row["name"] for row in ended["rows"] if row["status"] != "done"] == ["lapo-d10-s0"]
    row = next(row for row in ended["rows"] if row["method"] == "lapo")
    assert (row["status"], row["success_rate"], row["parameters"]) == ("failed", None, None)
    assert "lapo" not in {row["method"] for row in ended["summary"]}


def test_what_an_older_run_of_a_failed_job_left_is_not_counted(tmp_path: Path) -> None:
    job = finish(SuccessJob("lapo", 10, 0, tmp_path), {"simulation": 9})
    write_status(job.file, Status("failed", "f", "out of memory", 1.0))
    assert job_rows(job, 5, read_status(job.file))[0]["success_rate"] is None


@pytest.mark.parametrize("fault", [None, "seed", "episodes", "env", "render", "fingerprints", "first_seed", "", "run"])
def test_a_job_is_done_only_while_its_own_result_lies_there(
    fault: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = compose(["preset=smoke", "methods=lapo", "episodes=10", f"out={tmp_path}"], "compare")
    job = finish(SuccessJob("lapo", 10, 0, tmp_path), {"simulation": 9}, fingerprint="w")
    record = success_record(job, own := success_config(config, job, "pretrained"), {})
    path = job.run / "evaluation" / "simulation" / "eval_info.json"
    info = json.loads(path.read_text()) | {"seed": 100, "fingerprints": {"lapo": "w"}, **task_facts(own, 100)}
    write_json(path, info if fault is None else {**info, fault: "other"} if fault else {})
    if fault == "run":
        shutil.rmtree(job.run)
    assert SuccessMeasure.agrees(record) is (fault is None)

    write_json(job.file, record)
    write_status(job.file, Status("done", record["fingerprint"]))
    again = list[str]()
    monkeypatch.setattr(SuccessMeasure, "run", staticmethod(lambda record, _: again.append(record["name"])))
    assert compare_job.main(job.file).status == "done"
    assert again == ([] if fault is None else [job.name])


def test_parameters_count_floats_of_run_and_parents(tmp_path: Path) -> None:
    job = finish(SuccessJob("lapo", 10, 0, tmp_path), {"simulation": 9})
    assert count_parameters(Run(job.run), "lapo") == 12
    finish(SuccessJob("lapo", 10, 0, tmp_path), {"simulation": 9}, parents={"lapo_model": "x"})
    (job.run / "lapo_model").mkdir()
    (job.run / "lapo" / "checkpoint").rename(job.run / "lapo_model" / "checkpoint")
    finish(job, {"simulation": 9}, parents={"lapo_model": "x"})
    assert count_parameters(Run(job.run), "lapo") == 24


def test_the_page_has_the_table_the_footnotes_and_the_failure(ended: dict[str, Any]) -> None:
    page = to_markdown(success_page(ended))
    assert re.search(r"\| PlaySlot, simulation \| 70 % \(\d+ to \d+; seeds 60 to 80\) \| – \|", page)
    assert "| less PlaySlot | 10 demonstrations |" in page
    assert re.search(r"\| ResNet Oracle, simulation \| \*{0,2}−40 \(−\d+ to ", page), page
    assert "| Slot Oracle, simulation | 100 % (72 to 100) | 100 % (72 to 100) |" in page
    assert "| DreamerV3, 30 s on 2 cores | 10,000 | 70 % (40 to 89) |" in page
    assert "| DreamerV3, 30 s on 1 core |" in to_markdown(success_page({**ended, "threads": 1}))
    assert "PlaySlot saw the real actions of 5 of 10 demonstrations" in page
    assert "Slot Oracle saw the real actions of 10 of 10, 50 of 50 demonstrations" in page
    assert "ResNet Oracle starts from scratch weights" in page
    assert "still stretches of the videos are left out: ResNet Oracle 50 %." in page
    assert "**lapo-d10-s0: failed.** loss is nan at step 3" in page
    assert "DreamerV3: 10,000 environment steps, which are 2,000 agent steps of 5; mean over the seeds" in page
    assert "of training on 700 videos without actions" in page
    samples = "optimiser steps times batch (decoder and fine-tuning, which follow, not counted): Slot Oracle 1,600."
    assert f"Training of the policy, {samples}" in page
    assert "Failures: 1 of 7 jobs" in page
    assert "Not finished" not in page
    assert "over the Slot Oracle's: 70 % at 10 demonstrations" in page
    assert "expert: 100 % (70 to 100)" in page
    assert "PlaySlot 30 s a training, 8 s its evaluation" in page


@pytest.mark.parametrize(("method", "demos"), [("lapo", 10), ("dreamer", None)])
def test_a_cell_is_short_of_the_jobs_that_it_was_to_have(method: Any, demos: int | None, tmp_path: Path) -> None:
    jobs = [SuccessJob(method, demos, seed, tmp_path) for seed in range(2)]
    jobs.append(SuccessJob(method, 50, 0, tmp_path))
    finish(jobs[0], {"simulation": 7})
    rows = [row for job in jobs for row in job_rows(job, 5, read_status(job.file))]
    [found] = summarise(rows)
    assert cell(found, {"rows": rows, "seeds": [0, 1, 2]}) == "70 % (40 to 89; 1 of 2 seeds)"
    assert cell(found, {"rows": rows[:1], "seeds": [0, 1, 2]}) == "70 % (40 to 89)", "online seeds are fewer"


def test_a_job_that_waits_is_no_failure(tmp_path: Path) -> None:
    jobs = [finish(SuccessJob("lapo", 10, 0, tmp_path), {"simulation": 8}), SuccessJob("lapo", 50, 0, tmp_path)]
    rows = [row for job in jobs for row in job_rows(job, 5, read_status(job.file))]
    page = to_markdown(success_page({**comparison(tmp_path, rows), "jobs": 2}))
    assert "Failures: none." in page
    assert "Not finished: 1 of 2 jobs" in page


def test_a_cell_of_one_seed_has_no_range(ended: dict[str, Any]) -> None:
    assert cell(_of(ended, "resnet_oracle"), {**ended, "seeds": [0]}) == "40 % (17 to 69)"


def test_the_result_is_json(ended: dict[str, Any]) -> None:
    assert json.loads(json.dumps(ended, allow_nan=False)) == ended


def test_every_method_has_a_marker_of_its_own_and_kin_have_one_colour() -> None:
    styles = {name: method.style for name, method in METHODS.items() if method.acts}
    assert len({style.marker for style in styles.values()}) == len(styles)
    kin = {"slot_bc": "slot_oracle", "slot_vpt": "slot_oracle", "resnet_bc": "resnet_oracle"}
    kin |= {"laom": "lapo", "clam": "lapo"}
    assert [styles[name].colour for name in kin] == [styles[name].colour for name in kin.values()]
    assert {style.colour for style in styles.values()} == set(range(len(LIGHT.series))), "each before one is used again"


def test_seeds_of_a_method_that_acts_are_dots_beside_their_mean(ended: dict[str, Any]) -> None:
    first = next(row for row in ended["rows"] if row["method"] == "dreamer")
    second = {**first, "name": "dreamer-s1", "seed": 1, "success_rate": 0.1, "env_steps": 9000}
    rows = [*ended["rows"], second]
    figure = success_figure({**ended, "rows": rows, "summary": summarise(rows)}, LIGHT)
    points = [(tuple(line.get_xdata()), tuple(line.get_ydata())) for line in figure.axes[1].lines]
    assert ((10000, 9000), (pytest.approx(70), pytest.approx(10))) in points
    assert ((9500,), (pytest.approx(40),)) in points


def test_the_plot_shows_every_series_in_its_methods_colour(ended: dict[str, Any]) -> None:
    figure = success_figure(ended, LIGHT)
    left, right = figure.axes
    labels = left.get_legend_handles_labels()[1]
    assert {"PlaySlot", "PlaySlot, imagination", "Slot Oracle", "ResNet Oracle", "expert actions"} <= set(labels)
    shown = {}
    for axes in (left, right):
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            shown[label] = (handle[0] if isinstance(handle, tuple) else handle).get_color()
    for method, label in (
        ("playslot", "PlaySlot"), ("playslot", "PlaySlot, imagination"), ("slot_oracle", "Slot Oracle"),
        ("resnet_oracle", "ResNet Oracle"), ("dreamer", "DreamerV3, 30 s on 2 cores"),
    ):  # fmt: skip
        assert shown[label] == LIGHT.series[METHODS[method].style.colour]
    curve = max(right.get_lines(), key=lambda line: len(line.get_xdata()))
    assert list(curve.get_xdata()) == [0, 5000, 10000]
    assert curve.get_color() == LIGHT.series[METHODS["dreamer"].style.colour]


@pytest.mark.integration
@pytest.mark.parametrize("kind", ["png", "svg"])
def test_the_same_comparison_is_the_same_picture(ended: dict[str, Any], kind: str) -> None:
    pictures = [figure_bytes(success_figure(ended, LIGHT), LIGHT, kind) for _ in range(2)]
    assert pictures[0] == pictures[1]
    assert pictures[0].startswith(b"\x89PNG" if kind == "png" else b"<?xml")


def test_a_comparison_without_results_is_drawn_too(ended: dict[str, Any]) -> None:
    rows = [row for row in ended["rows"] if row["method"] == "lapo"]
    empty = {**ended, "rows": rows, "summary": []}
    assert figure_bytes(success_figure(empty, LIGHT), LIGHT, "png")
    assert "**lapo-d10-s0: failed.**" in to_markdown(success_page(empty))
