"""Several world models, videos on the axis, differences on pairs, and blocks of episodes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from jobs_on_disk import comparison, finish

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.compose import compose
from playslot_rl.errors import ConfigError
from playslot_rl.evaluation.intervals import newcombe, wilson
from playslot_rl.seeds.episodes import TEST_BLOCKS
from playslot_rl.storage.atomic import write_json
from playslot_rl.studies.launch import Status, read_status, write_status
from playslot_rl.studies.study import origin_notes
from playslot_rl.studies.success.block import block_of, with_block
from playslot_rl.studies.success.figure import success_figure
from playslot_rl.studies.success.jobs import (
    SuccessJob,
    model_folder,
    model_named,
    success_config,
    success_jobs,
    success_record,
    world_parts,
    world_runs,
)
from playslot_rl.studies.success.measure import job_rows, task_results
from playslot_rl.studies.success.page import success_page
from playslot_rl.studies.success.summary import across_tasks, differences, summarise
from playslot_rl.visualization.charts import LIGHT
from playslot_rl.visualization.document import to_markdown

OUT = Path("out")


def compared(*typed: str) -> ExperimentConfig:
    return compose(["preset=compact", *typed], "compare")


def names(*typed: str) -> list[str]:
    return [job.name for job in success_jobs(compared(*typed), OUT)]


def rows_of(*jobs: SuccessJob) -> list[dict[str, Any]]:
    return [row for job in jobs for row in job_rows(job, 5, read_status(job.file))]


def test_each_world_model_has_the_jobs_of_all_seeds_and_methods_without_one_have_theirs_once() -> None:
    typed = ("methods=playslot,lapo,resnet_bc", "demos=100", "labels=5", "seeds=0,1", "worlds=2")
    assert names(*typed) == [
        "resnet_bc-d5-l5-s0", "playslot-d100-l5-s0", "lapo-d100-l5-s0",
        "resnet_bc-d5-l5-s1", "playslot-d100-l5-s1", "lapo-d100-l5-s1",
        "playslot-d100-l5-w1-s0", "lapo-d100-l5-w1-s0", "playslot-d100-l5-w1-s1", "lapo-d100-l5-w1-s1",
    ]  # fmt: skip


def test_jobs_of_the_first_world_model_are_the_jobs_of_a_comparison_of_one() -> None:
    typed = ("methods=playslot,lapo", "demos=100", "labels=5,10", "seeds=0")
    records = []
    for more in ((), ("worlds=3", "compare.runs=a,b", "compare.tasks=c")):
        config = compared(*typed, *more)
        jobs = [job for job in success_jobs(config, OUT) if not job.world]
        plain = compared(*typed)  # what a job's config has of the comparison is its block alone
        records.append([success_record(job, success_config(plain, job, "world"), {"slots": "a"}) for job in jobs])
    assert records[0] == records[1]


def test_a_job_takes_the_model_and_the_shared_policy_of_its_own_number() -> None:
    job = SuccessJob("lapo", 100, 0, OUT, 10, 5, world=2)
    own = success_config(compared("methods=lapo", "labels=5,10", "demos=100"), job, "w2")
    assert own.baselines.lapo.world == str((OUT / "lapo_world_2").resolve())  # type: ignore[attr-defined]
    assert Path(own.behaviour.policy_from).name == "lapo-d100-l5-w2-s0"
    config = compared("methods=lapo", "demos=100", "baselines.lapo.world=runs/other")
    for of, first in ((compared("methods=lapo", "demos=100"), OUT / "lapo_world"), (config, Path("runs/other"))):
        found = [model_folder(of, "lapo_model", OUT, number) for number in (0, 1)]
        assert found == [first, OUT / "lapo_world_1"]
    taken = success_config(config, replace(job, world=0), "w0").baselines.lapo
    assert taken.world == str(Path("runs/other").resolve())  # type: ignore[attr-defined]
    assert (
        model_named(compared("methods=caddy_policy,caddy_oracle", "demos=9", "baselines.caddy_policy.world=a"), "caddy")
        == "a"
    )
    assert success_record(job, own, {})["world"] == 2


def test_dynamics_are_asked_for_where_a_method_builds_on_them() -> None:
    assert world_parts(["slot_bc", "slot_oracle", "lapo_slots", "sold", "resnet_bc"]) == ("slots",)
    assert world_parts(["slot_bc", "playslot"]) == ("slots", "dynamics")
    assert world_parts(["resnet_bc", "lapo", "act"]) == ()


def test_world_models_are_named_by_run_and_runs() -> None:
    assert world_runs(compared("run=a", "worlds=3", "compare.runs=b, c")) == ("a", "b", "c")
    with pytest.raises(ConfigError, match=r"compare\.runs: got 'b', expected fewer than the 1 of worlds="):
        compared("run=a", "compare.runs=b")


def test_videos_are_counted_on_top_of_the_labelled_ones() -> None:
    typed = ("methods=playslot,slot_bc,slot_oracle", "labels=10", "compare.videos=[0,50]", "seeds=0")
    assert names(*typed) == [
        "slot_bc-d10-l10-s0", "playslot-d10-l10-s0", "slot_oracle-d10-s0", "playslot-d60-l10-s0", "slot_oracle-d60-s0",
    ]  # fmt: skip
    assert names(*typed[:1], "labels=5,10", "videos=50", "seeds=0")[2:] == [
        "playslot-d55-l5-s0", "slot_oracle-d55-s0", "playslot-d60-l10-s0", "slot_oracle-d60-s0",
    ]  # fmt: skip


@pytest.fixture
def two_worlds(tmp_path: Path) -> list[dict[str, Any]]:
    """PlaySlot on two world models, LAPO that is as good on one and lost on the other, and a ResNet."""
    jobs = [
        finish(SuccessJob("playslot", 100, seed, tmp_path, 5, world=world), {"simulation": 70}, 100)
        for world in (0, 1)
        for seed in (0, 1)
    ]
    jobs += [
        finish(SuccessJob("lapo", 100, seed, tmp_path, 5, world=world), {"simulation": 10 if world else 70}, 100)
        for world in (0, 1)
        for seed in (0, 1)
    ]
    jobs += [finish(SuccessJob("resnet_bc", 5, seed, tmp_path, 5), {"simulation": 20}, 100) for seed in (0, 1)]
    return rows_of(*jobs)


def test_the_interval_knows_that_world_models_differ(two_worlds: list[dict[str, Any]]) -> None:
    summary = {row["method"]: row for row in summarise(two_worlds) if row["protocol"] == "simulation"}
    assert (summary["lapo"]["worlds"], summary["lapo"]["runs"]) == ([0, 1], 4)
    assert summary["lapo"]["ci95"][0] < wilson(40, 100)[0] - 0.1
    assert summary["resnet_bc"]["worlds"] == [0]
    page = to_markdown(success_page({**comparison(OUT, two_worlds), "worlds": 2, "labels": [5]}))
    assert "; policies 10 to 70)" in page
    assert "bootstrap interval over world models, seeds and episodes" in page


def test_differences_are_of_pairs(two_worlds: list[dict[str, Any]]) -> None:
    found = {row["method"]: row for row in differences(two_worlds, "playslot") if row["protocol"] == "simulation"}
    assert found.keys() == {"lapo", "resnet_bc"}
    assert found["resnet_bc"]["difference"] == pytest.approx(-0.5)
    assert found["resnet_bc"]["leaves_out_0"]
    assert (found["resnet_bc"]["demos"], found["resnet_bc"]["labels"]) == (100, 5)
    assert found["lapo"]["difference"] == pytest.approx(-0.3)
    assert not found["lapo"]["leaves_out_0"], "on one of two world models there is no difference"


def by_worlds(out: Path, done: dict[str, dict[tuple[int, int], int]], planned: int = 3) -> list[dict[str, Any]]:
    """Two seeds on each world model; finished are those (world, seed) that have successes, of 100."""
    jobs = []
    for method, won in done.items():
        for place in [(world, seed) for world in range(planned) for seed in (0, 1)]:
            job = SuccessJob(method, 100, place[1], out, 5, world=place[0])
            jobs.append(finish(job, {"simulation": won[place]}, 100) if place in won else job)
    return [row for row in rows_of(*jobs) if row["protocol"] == "simulation"]


def test_a_difference_is_of_the_world_models_that_both_have_finished(tmp_path: Path) -> None:
    whole = {(world, seed): 90 - 40 * (world > 0) for world in range(3) for seed in (0, 1)}
    (row,) = differences(by_worlds(tmp_path, {"playslot": whole, "lapo": {(0, 0): 90}}), "playslot")
    assert (row["difference"], row["seeds"], row["leaves_out_0"]) == (0.0, [0], False), "not against the other worlds"


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        ([(0, 0)], [(1, 0)]),
        ([(0, 0), (1, 0)], [(2, 0)]),
        ([(0, 0), (0, 1), (1, 0)], [(1, 1), (2, 0)]),
        ([(0, 0), (1, 1)], [(0, 1), (1, 0)]),
    ],
)
def test_jobs_without_a_pair_have_no_difference(
    ours: list[tuple[int, int]], theirs: list[tuple[int, int]], tmp_path: Path
) -> None:
    rows = by_worlds(tmp_path, {"playslot": dict.fromkeys(ours, 90), "lapo": dict.fromkeys(theirs, 10)})
    assert differences(rows, "playslot") == []


def test_a_method_of_one_world_model_meets_all_that_are_finished(tmp_path: Path) -> None:
    rows = by_worlds(tmp_path, {"playslot": {(1, 0): 90, (2, 1): 70}})
    rows += by_worlds(tmp_path, {"resnet_bc": {(0, 0): 10, (0, 1): 10}}, planned=1)
    (row,) = differences(rows, "playslot")
    assert (row["difference"], row["seeds"]) == (pytest.approx(-0.7), [0, 1])


def test_the_difference_of_a_row_to_its_double_is_0(tmp_path: Path) -> None:
    won = {"simulation": 6}
    jobs = [finish(SuccessJob(name, 100, 0, tmp_path, 5), won) for name in ("playslot", "lapo")]
    (row,) = differences([row for row in rows_of(*jobs) if row["protocol"] == "simulation"], "playslot")
    assert (row["difference"], row["leaves_out_0"]) == (0.0, False)
    assert row["ci95"] == pytest.approx(newcombe(6, 0, 0, 10)), "ten pairs say no more"


def test_the_page_has_a_table_and_the_plot_an_axis_of_videos(tmp_path: Path) -> None:
    jobs = [finish(SuccessJob("playslot", n, 0, tmp_path, 10), {"simulation": won}) for n, won in ((10, 2), (60, 7))]
    jobs.append(finish(SuccessJob("slot_bc", 10, 0, tmp_path, 10), {"simulation": 1}))
    jobs.append(finish(SuccessJob("slot_oracle", 60, 0, tmp_path), {"simulation": 9}))
    result = {**comparison(tmp_path, rows_of(*jobs)), "videos": [0, 50], "seeds": [0], "labels": [10]}
    page = to_markdown(success_page(result))
    assert page.startswith("# button_press: success against videos, on a development block")
    table = page.partition("## By unlabelled videos, beside 10 labelled demonstrations")[2]
    assert "|  | 0 videos | 50 videos |" in table
    assert "| PlaySlot, simulation | 20 % (" in table
    assert "From the labels alone: Slot BC 10 % (" in table
    assert "| Slot BC, simulation | −10 (" in table.replace("**", "")
    (axes,) = success_figure(result, LIGHT).axes
    assert axes.get_xlabel() == "unlabelled videos of demonstrations"
    assert [label.get_text() for label in axes.get_xticklabels()] == ["0", "50"]
    assert "Slot BC" in {line.get_label() for line in axes.lines}


def test_a_test_block_is_drawn_once_for_a_folder(tmp_path: Path) -> None:
    config = compared(f"out={tmp_path}", "compare.block=test")
    first = with_block(config)
    assert first.compare.evaluation_seed >= TEST_BLOCKS
    assert with_block(config) == first
    assert block_of(first)["kind"] == "test"
    assert block_of(first)["date"] == json.loads((tmp_path / "test_block.json").read_text())["date"]
    other = with_block(compared(f"out={tmp_path / 'other'}", "compare.block=test"))
    assert other.compare.evaluation_seed != first.compare.evaluation_seed
    typed = with_block(compared(f"out={tmp_path}", "compare.block=test", f"compare.evaluation_seed={TEST_BLOCKS + 7}"))
    assert typed.compare.evaluation_seed == TEST_BLOCKS + 7, "one block for the tables of several tasks"


def test_a_table_on_a_development_block_is_marked(two_worlds: list[dict[str, Any]]) -> None:
    result = {**comparison(OUT, two_worlds), "block": {"number": TEST_BLOCKS, "kind": "test"}}
    assert "development" not in to_markdown(success_page(result))
    config = compared()
    assert with_block(config) == config
    result["block"] = block_of(config)
    page = to_markdown(success_page(result))
    assert "**Block 100 is a development block**" in page
    assert ", on a development block" in page.splitlines()[0]


def test_jobs_of_several_commits_or_processors_are_named(tmp_path: Path) -> None:
    jobs = [finish(SuccessJob("lapo", 10, n, tmp_path), {"simulation": 5}, commit="aa") for n in range(3)]
    for job in jobs:
        write_status(job.file, Status("done", "f", "", 1.0, "aa", "one kind"))
    assert origin_notes(rows_of(*jobs)) == [
        "Every job is of one commit: aa.",
        "Every job is of one kind of processor: one kind.",
    ]
    write_status(jobs[2].file, Status("done", "f", "", 1.0, "bb", "another"))
    commits, kinds = origin_notes(rows_of(*jobs))
    assert commits == "**Jobs are of more than one commit.** aa: 3 of 3 jobs; bb: lapo-d10-s2."
    assert kinds == "**Jobs are of more than one kind of processor.** one kind: 2 of 3 jobs; another: lapo-d10-s2."


def test_the_interquartile_mean_is_over_the_policies_of_all_tasks(tmp_path: Path) -> None:
    results = []
    for task, rates in (("easy", (8, 10)), ("hard", (0, 2))):
        jobs = [
            finish(SuccessJob("playslot", 100, seed, tmp_path / task, 5), {"simulation": won})
            for seed, won in enumerate(rates)
        ]
        results.append({"rows": rows_of(*jobs)})
    (row,) = [row for row in across_tasks(results) if row["protocol"] == "simulation"]
    assert (row["method"], row["labels"]) == ("playslot", 5)
    assert row["score"] == pytest.approx(0.5), "the middle two of 0, 20, 80 and 100 %"
    low, high = row["ci95"]
    assert low < 0.5 < high


def test_a_comparison_of_before_outcomes_is_refused_among_tasks(tmp_path: Path) -> None:
    write_json(tmp_path / "comparison.json", {"rows": [{"name": "old"}]})
    with pytest.raises(ConfigError, match=r"compare\.tasks: got .* without outcomes in comparison\.json, expected"):
        task_results(compared(f"compare.tasks={tmp_path}"))
