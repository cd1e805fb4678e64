"""Comparisons of several tasks: what each is, the table over them, and that one that fails stops no other."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from jobs_on_disk import comparison, finish

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.compose import compose, compose_each
from playslot_rl.config.methods import METHODS
from playslot_rl.errors import ConfigError, PlaySlotError
from playslot_rl.recipes import compare
from playslot_rl.storage.atomic import write_json
from playslot_rl.studies.launch import comparison_lock, read_status
from playslot_rl.studies.success import tasks
from playslot_rl.studies.success.figure import tasks_figure
from playslot_rl.studies.success.jobs import SuccessJob, success_jobs
from playslot_rl.studies.success.measure import SuccessMeasure, check_success, job_rows
from playslot_rl.studies.success.page import success_page
from playslot_rl.studies.success.summary import differences, summarise
from playslot_rl.studies.success.task_table import joint_table, tasks_page
from playslot_rl.visualization.charts import LIGHT
from playslot_rl.visualization.document import to_markdown

TWO = "envs=metaworld/door-open,block_push_easy"


def each(*typed: str) -> list[ExperimentConfig]:
    return compose_each(["preset=compact", "methods=playslot,slot_bc", "demos=20", "labels=5", *typed], "compare")


def test_each_task_has_its_own_settings_and_all_that_was_typed() -> None:
    door, push = each(TWO, "env.variation.shake=0.5", "episodes=7")
    names = ["metaworld_door-open_shake0.5", "block_push_easy_shake0.5"]
    assert [config.env.full_name for config in (door, push)] == names
    assert (door.env.max_steps, push.env.max_steps) == (25, 25)
    assert (door.env.frame_skip, push.env.frame_skip) == (5, 2)
    assert {(config.env.variation.shake, config.episodes) for config in (door, push)} == {(0.5, 7)}
    alone = compose(["preset=compact", "env=block_push_easy"])
    assert (push.model, push.behaviour, push.collect) == (alone.model, alone.behaviour, alone.collect)
    assert [config.compare.labels for config in each("envs=button_press")] == [(5,)]


def test_a_gymnasium_id_is_a_task_of_its_own() -> None:
    (config,) = each("envs=gym/FetchReach-v4")
    assert (config.env.id, config.env.full_name) == ("FetchReach-v4", "gym_FetchReach-v4")


def test_an_expert_is_of_gymnasiums_environments_alone() -> None:
    typed = ("expert=gym_examples:reach", "+env.success=won", "hydra.launcher=joblib", "hydra.launcher.n_jobs=${x.y}")
    gym, push = each("envs=gym/FetchReach-v4,block_push_easy", *typed)
    assert (gym.env.expert, gym.env.success) == ("gym_examples:reach", "won")
    assert (push.env.expert, push.env.success) == ("", "")
    with pytest.raises(ConfigError, match=r"env\.expert"):
        each("envs=block_push_easy", "expert=gym_examples:reach")


def test_a_varied_task_has_a_name_and_a_folder_of_its_own() -> None:
    for typed, name in (
        ([], "block_push_easy"),
        (["background=true", "object=true"], "block_push_easy_background_object"),
        (["shake=0.5", "seed=1"], "block_push_easy_shake0.5_seed1"),
        (["colours=1"], "block_push_easy_colours1"),
        (["seed=1"], "block_push_easy"),
    ):
        varied = [f"env.variation.{key}" for key in typed]
        assert compose(["env=block_push_easy", *varied]).env.full_name == name


@pytest.mark.parametrize(
    ("typed", "message"),
    [
        (
            ["envs=block_push_easy,metaworld/drawer-opn"],
            "got 'drawer-opn', .* did you mean drawer-open or drawer-close",
        ),
        (["envs=block_push_easy,block_psh"], "unknown env 'block_psh': .* did you mean env=block_push"),
        (["envs=block_push_easy/red"], r"env\.task: got 'red', expected none with env\.name=block_push_easy"),
        (["envs=button_press,button_press"], r"envs: got .*, expected each one once"),
        ([TWO, "env=button_press"], "env: got button_press with envs=, expected none: it is of one task"),
        ([TWO, "data.demos=data/expert"], r"data\.demos: got data/expert with envs=, expected none"),
    ],
)
def test_what_cannot_be_a_list_of_tasks_is_one_line(typed: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as error:
        each(*typed)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("names", ["metaworld/push,metaworld/push-v3", "block_push_easy,grid_shapes"])
def test_what_no_command_can_compare_is_refused_before_anything_is_written(names: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"which are metaworld_push, expected|env=grid_shapes: got an environment"):
        compare.main(*each(f"envs={names}", f"out={tmp_path / 'out'}"))
    assert not (tmp_path / "out").exists()


def ended(folder: Path, env: str, playslot: tuple[int, int], slot_bc: tuple[int, int]) -> dict[str, Any]:
    """A comparison of two seeds, 10 episodes each."""
    folder = folder / env
    jobs = [finish(SuccessJob("playslot", 20, n, folder, 5), {"simulation": playslot[n]}) for n in (0, 1)]
    jobs += [finish(SuccessJob("slot_bc", 5, n, folder, 5), {"simulation": slot_bc[n]}) for n in (0, 1)]
    jobs += [finish(SuccessJob("slot_oracle", 20, 0, folder), {"simulation": 10})] if env == "easy" else []
    rows = [row for job in jobs for row in job_rows(job, 5, read_status(job.file))]
    return {**comparison(folder, [row for row in rows if row["protocol"] == "simulation"]), "env": env, "labels": [5]}


@pytest.fixture
def results(tmp_path: Path) -> list[dict[str, Any]]:
    return [ended(tmp_path, "easy", (10, 8), (5, 3)), ended(tmp_path, "hard", (2, 4), (3, 3))]


def test_the_table_over_tasks_has_every_rate_and_the_mean_of_the_middle_half(results: list[dict[str, Any]]) -> None:
    joint = joint_table(results, "playslot")
    rates = {(row["env"], row["method"], row["labels"]): row["success_rate"] for row in joint["summary"]}
    assert rates == {
        ("easy", "playslot", 5): 0.9, ("easy", "slot_bc", 5): 0.4, ("easy", "slot_oracle", None): 1.0,
        ("hard", "playslot", 5): pytest.approx(0.3), ("hard", "slot_bc", 5): pytest.approx(0.3),
    }  # fmt: skip
    scores = {row["method"]: row["score"] for row in joint["rows"]}
    assert scores == {
        "playslot": pytest.approx(0.6),  # the middle two of 20, 40, 80 and 100 %
        "slot_bc": pytest.approx(0.3),  # of 30, 30, 30 and 50 %
    }, "the oracle is not finished in both"
    for row in joint["rows"]:
        assert row["ci95"][0] < row["score"] < row["ci95"][1]
    assert joint["ahead"] == [{"labels": 5, "ahead": ["easy"], "surely": ["easy"], "behind": ["hard"]}], (
        "equal is not ahead"
    )


def test_the_page_of_tasks_shows_them(results: list[dict[str, Any]], tmp_path: Path) -> None:
    page = to_markdown(success_page({**results[0], "across_tasks": joint_table(results, "playslot")}))
    table = page.partition("## Over tasks, with 5 labelled demonstrations")[2]
    assert "| success, % | PlaySlot | Slot BC |" in table
    assert "| easy | 90 (" in table
    assert "| interquartile mean | 60 (" in table
    said = "PlaySlot is ahead of all methods on the labels alone in 1 of 2 tasks, by intervals that leave out 0 in 1;"
    assert f"{said} not in hard." in table
    assert "| hard | – |" in page.partition("## Over tasks\n")[2], "the oracle was not measured there"


def test_the_mean_difference_over_tasks_is_shown_on_pairs(results: list[dict[str, Any]]) -> None:
    joint = joint_table(results, "playslot")
    (row,) = joint["differences"]
    assert (row["method"], row["labels"], row["difference"]) == ("slot_bc", 5, pytest.approx(-0.25))  # -50 and 0 points
    low, high = row["ci95"]
    assert low < row["difference"] < high
    page = to_markdown(success_page({**results[0], "across_tasks": joint}))
    table = page.partition("## Over tasks, with 5 labelled demonstrations")[2].partition("## ")[0]
    assert re.search(r"\| less PlaySlot, points \| – \| \**−25 \(", table)
    assert "Of 20 demonstrations, the most there are, where not of labels alone." in table
    lost = [results[0], lacking(results[1], "slot_bc-d5-l5-s1")]
    assert joint_table(lost, "playslot")["differences"] == [], "not of all runs"


def test_a_reference_on_labels_alone_is_not_held_against_itself(results: list[dict[str, Any]]) -> None:
    lost = {"outcomes": "0" * 10, "success_rate": 0.0, "successes": 0}
    own = [row for row in results[0]["rows"] if row["method"] == "slot_bc"]
    others = [{**row, **lost, "method": "resnet_bc", "name": row["name"].replace("slot", "resnet")} for row in own]
    rows = [*results[0]["rows"], *others]
    result = {**results[0], "rows": rows, "summary": summarise(rows), "differences": differences(rows, "slot_bc")}
    assert joint_table([result], "slot_bc")["ahead"] == [
        {"labels": 5, "ahead": ["easy"], "surely": ["easy"], "behind": []}
    ]


def test_the_picture_of_tasks_is_of_as_many_demonstrations_as_their_table(tmp_path: Path) -> None:
    found = [finish(SuccessJob("playslot", n, 0, tmp_path, 5), {"simulation": n // 5}) for n in (20, 40)]
    rows = [row for job in found for row in job_rows(job, 5, read_status(job.file)) if row["protocol"] == "simulation"]
    result = {**comparison(tmp_path, rows), "env": "easy", "labels": [5]}
    (cell,) = joint_table([result], "playslot")["cells"]
    (axes,) = tasks_figure({"easy": result}, LIGHT).axes
    assert (axes.get_title(), cell["success_rate"]) == ("easy\n40 videos", 0.8)
    assert [list(line.get_ydata()) for line in axes.lines if line.get_marker() == METHODS["playslot"].style.marker] == [
        [80]
    ]


def test_a_task_without_success_is_said_to_be_measured_by_return(results: list[dict[str, Any]]) -> None:
    joint, line = joint_table(results, "playslot"), "Of hard no success is measured, but the return"
    for returns in (False, True):
        for cell in (cell for cell in joint["cells"] if returns and cell["env"] == "hard"):
            cell["success_rate"] = None
        page = to_markdown(tasks_page({**results[0], "across_tasks": joint, "errors": {}, "blocks": []}))
        assert (line in page) == returns


def test_ahead_by_an_episode_is_not_surely_ahead(tmp_path: Path) -> None:
    close = joint_table([ended(tmp_path, "easy", (5, 4), (5, 3))], "playslot")
    assert close["ahead"] == [{"labels": 5, "ahead": ["easy"], "surely": [], "behind": []}]


def lacking(result: dict[str, Any], *names: str) -> dict[str, Any]:
    """The comparison with jobs of these names failed."""
    rows = [
        {**row, "status": "failed", "success_rate": None, "outcomes": None} if row["name"] in names else row
        for row in result["rows"]
    ]
    return {**result, "rows": rows, "summary": summarise(rows)}


def test_a_cell_that_lacks_a_run_is_shown_and_in_no_mean(results: list[dict[str, Any]]) -> None:
    broken = [results[0], lacking(results[1], "slot_bc-d5-l5-s1")]
    joint = joint_table(broken, "playslot")
    assert [row["method"] for row in joint["rows"]] == ["playslot"]
    assert joint["ahead"] == [{"labels": 5, "ahead": ["easy"], "surely": ["easy"], "behind": []}]
    assert [row["env"] for row in joint["summary"] if row["method"] == "slot_bc"] == ["easy", "hard"]
    page = to_markdown(success_page({**results[0], "across_tasks": joint}))
    table = page.partition("## Over tasks, with 5 labelled demonstrations")[2].partition("## ")[0]
    line = next(line for line in table.splitlines() if line.startswith("| hard |"))
    assert line.split("|")[3].strip().startswith("30 (")
    assert line.split("|")[3].strip().endswith("; 1 of 2 seeds)")
    assert re.search(r"\| interquartile mean \| 60 \(\d+ to \d+\) \| – \|", table)
    assert "in 1 of 1 tasks that have all runs," in table
    nothing = joint_table([results[0], lacking(results[1], "slot_bc-d5-l5-s0", "slot_bc-d5-l5-s1")], "playslot")
    page = to_markdown(success_page({**results[0], "across_tasks": nothing}))
    assert re.search(r"\| hard \| 30 \(.*\) \| – \(0 of 2 seeds\) \|", page)


def test_the_largest_number_of_demonstrations_counts_finished_or_not(tmp_path: Path) -> None:
    jobs = [finish(SuccessJob("playslot", 10, n, tmp_path, 5), {"simulation": 9}) for n in (0, 1)]
    jobs += [SuccessJob("playslot", 50, n, tmp_path, 5) for n in (0, 1)]
    rows = [row for job in jobs for row in job_rows(job, 5, read_status(job.file)) if row["protocol"] == "simulation"]
    joint = joint_table([{"env": "easy", "rows": rows, "summary": summarise(rows)}], "playslot")
    assert joint["rows"] == []
    (cell,) = joint["cells"]
    assert (cell["demos"], cell["runs"], cell["of"], cell["success_rate"]) == (50, 0, 2, None)


def test_jobs_of_each_task_lie_in_its_folder(tmp_path: Path) -> None:
    measures = tasks._measures(each(TWO, "seeds=0"), tmp_path)
    files = [
        job.file for measure in measures.values() for job in success_jobs(measure.config, Path(measure.config.out))
    ]
    names = ["slot_bc-d5-l5-s0.json", "playslot-d20-l5-s0.json"]
    assert files == [
        tmp_path / task / "jobs" / name for task in ("metaworld_door-open", "block_push_easy") for name in names
    ]


def test_each_task_is_compared_once(results: list[dict[str, Any]], tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_json(tmp_path / name / "comparison.json", {**results[0], "env": "block_push_easy"})
    twice = rf"^compare\.tasks: got {tmp_path / 'b'} of block_push_easy, which is compared already, expected each task"
    config = compose(["preset=compact", "methods=lapo", f"compare.tasks={tmp_path / 'a'},{tmp_path / 'b'}"], "compare")
    with pytest.raises(ConfigError, match=twice):
        check_success(config)
    own = ["preset=compact", "env=block_push_easy", "methods=lapo", f"compare.tasks={tmp_path / 'b'}"]
    with pytest.raises(ConfigError, match=twice):
        check_success(compose(own, "compare"))


@pytest.mark.parametrize(
    ("env", "message"), [("block_push_easy", "which is compared already"), ("", "without outcomes in comparison.json")]
)
def test_other_tasks_are_read_before_anything_is_computed(
    env: str, message: str, results: list[dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tasks, "compute_study", lambda measure: pytest.fail(f"computed {measure.config.env.full_name}"))
    other, out = tmp_path / "other", tmp_path / "out"
    write_json(other / "comparison.json", {**results[0], "env": env} if env else {})
    with pytest.raises(ConfigError, match=message):
        compare.main(*each(TWO, f"out={out}", f"compare.tasks={other}"))
    assert not out.exists()


def test_a_task_that_fails_stops_no_other_and_the_table_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, turns = tmp_path / "out", list[str]()
    broken = {"metaworld_door-open"}

    def stub(measure: SuccessMeasure) -> str:
        env = measure.config.env.full_name
        turns.append(env)
        if env in broken:
            raise ConfigError("no such world model")
        write_json(out / env / "comparison.json", ended(out, env, (10, 8), (5, 3)))
        return ""

    monkeypatch.setattr(tasks, "compute_study", stub)
    command = each(TWO, f"out={out}")
    with pytest.raises(
        PlaySlotError, match=r"^compare: 1 of 2 tasks failed \(metaworld_door-open\), the others finished"
    ):
        compare.main(*command)
    assert turns == ["metaworld_door-open", "block_push_easy"]
    found = json.loads((out / "comparison.json").read_text())
    assert (found["across_tasks"]["tasks"], found["errors"]) == (["block_push_easy"], {turns[0]: "no such world model"})
    assert "**metaworld_door-open: no such world model**" in (out / "comparison.md").read_text()
    broken.clear()
    compare.main(*command)
    found = json.loads((out / "comparison.json").read_text())
    assert (found["across_tasks"]["tasks"], found["errors"]) == (turns[:2], {})
    assert {path.name for path in out.glob("comparison.*")} == {
        f"comparison.{e}" for e in ("json", "lock", "md", "png", "svg")
    }
    with comparison_lock(out), pytest.raises(PlaySlotError, match="that another comparison works on"):
        compare.main(*command)


def test_the_folder_of_one_tasks_comparison_is_none_for_several(tmp_path: Path) -> None:
    (tmp_path / "jobs").mkdir()
    with pytest.raises(PlaySlotError, match="got the comparison of one task, expected none, or one of envs="):
        compare.main(*each(TWO, f"out={tmp_path}"))
