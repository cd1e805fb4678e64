"""Comparisons by labels: which jobs there are, what they learn from, and how table and plot show them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from jobs_on_disk import comparison, finish

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.compose import compose
from playslot_rl.studies.launch import read_status
from playslot_rl.studies.success.figure import success_figure
from playslot_rl.studies.success.jobs import SuccessJob, success_config, success_jobs
from playslot_rl.studies.success.measure import job_rows
from playslot_rl.studies.success.page import success_page
from playslot_rl.visualization.charts import LIGHT
from playslot_rl.visualization.document import to_markdown

OUT = Path("out")


def compared(*typed: str) -> ExperimentConfig:
    return compose(["preset=compact", *typed], "compare")


def test_bc_has_a_job_for_each_number_of_labels_and_the_oracles_one_for_all() -> None:
    typed = ("methods=playslot,lapo,slot_bc,resnet_bc,slot_oracle", "demos=100", "labels=25,5", "seeds=3")
    assert [job.name for job in success_jobs(compared(*typed), OUT)] == [
        "slot_bc-d5-l5-s3", "resnet_bc-d5-l5-s3", "slot_bc-d25-l25-s3", "resnet_bc-d25-l25-s3",
        "playslot-d100-l5-s3", "playslot-d100-l25-s3", "lapo-d100-l5-s3", "lapo-d100-l25-s3", "slot_oracle-d100-s3",
    ]  # fmt: skip


@pytest.mark.parametrize("method", ["playslot", "lapo", "caddy_policy"])
def test_the_policy_is_trained_once_for_all_numbers_of_labels(method: str) -> None:
    first, second = success_jobs(compared(f"methods={method}", "demos=100", "labels=5,25", "seeds=0"), OUT)
    assert (first.policy_of, second.policy_of) == (None, 5)
    config = compared(f"methods={method}", "demos=100", "labels=5,25")
    assert success_config(config, first, "pretrained").behaviour.policy_from == ""
    assert success_config(config, second, "pretrained").behaviour.policy_from == str(first.run.resolve())


def test_a_policy_that_labels_count_in_is_trained_for_each() -> None:
    jobs = success_jobs(compared("methods=slot_vpt,laom", "demos=100", "labels=5,25", "seeds=0"), OUT)
    assert [(job.labels, job.policy_of) for job in jobs] == [(5, None), (25, None)] * 2


@pytest.mark.parametrize(
    ("method", "demos", "labels", "expected"),
    [("playslot", 100, 5, (100, 5)), ("lapo", 100, 25, (100, 25)), ("caddy_policy", 100, 25, (100, 25)),
     ("slot_bc", 5, 5, (5, 5)), ("resnet_bc", 25, 25, (25, 25)), ("slot_oracle", 100, None, (100, 50)),
     ("caddy_oracle", 100, None, (100, 50))],
)  # fmt: skip
def test_every_method_learns_from_the_draw_of_its_seed(
    method: Any, demos: int, labels: int | None, expected: tuple[int, int]
) -> None:
    own = success_config(compared(), SuccessJob(method, demos, 7, OUT, labels), "pretrained")
    assert (own.demos, own.behaviour.labelled_demos) == expected
    assert own.data.draw == 7, "the same draw for all methods: BC's labelled demonstrations are PlaySlot's"


@pytest.fixture
def by_labels(tmp_path: Path) -> dict[str, Any]:
    """PlaySlot with two numbers of videos, BC, and an oracle."""
    ended = [
        finish(SuccessJob("slot_bc", 5, 0, tmp_path, 5), {"simulation": 4}, labelled_demos=5),
        finish(SuccessJob("slot_bc", 25, 0, tmp_path, 25), {"simulation": 5}, labelled_demos=25),
        *(
            finish(
                SuccessJob("playslot", videos, 0, tmp_path, labels),
                {"simulation": won, "imagination": won - 1},
                labelled_demos=labels,
            )
            for videos, labels, won in ((100, 5, 6), (100, 25, 7), (300, 5, 8), (300, 25, 9))
        ),
        finish(SuccessJob("slot_oracle", 300, 0, tmp_path), {"simulation": 10}),
    ]
    rows = [row for job in ended for row in job_rows(job, 5, read_status(job.file))]
    return comparison(tmp_path, rows)


def test_the_page_has_a_table_for_each_number_of_videos_with_bc_in_each(by_labels: dict[str, Any]) -> None:
    page = to_markdown(success_page(by_labels))
    assert page.startswith("# button_press: success against labels")
    few, many = page.partition("## By labelled demonstrations, of 300 videos")[::2]
    assert "of 100 videos" in few
    for part, playslot in ((few, ("60 %", "70 %")), (many, ("80 %", "90 %"))):
        table = part.partition("|  | 5 labelled | 25 labelled |")[2].partition("| less PlaySlot |")[0]
        lines = {line.split("|")[1].strip(): line for line in table.splitlines() if line.startswith("| ")}
        assert all(rate in lines["PlaySlot, simulation"] for rate in playslot)
        assert "40 %" in lines["Slot BC, simulation"]
    assert "With the actions of all 300: Slot Oracle 100 %" in many
    assert "With the actions of all" not in few
    assert "PlaySlot saw the real actions of 5, 25 of 100, 5, 25 of 300 demonstrations" in page


@pytest.mark.parametrize("videos", [[], [90, 290]])
def test_methods_on_the_labels_alone_are_compared_in_every_table(videos: list[int], tmp_path: Path) -> None:
    ended = [
        finish(SuccessJob("slot_bc", 10, 0, tmp_path, 10), {"simulation": 4}),
        finish(SuccessJob("resnet_bc", 10, 0, tmp_path, 10), {"simulation": 6}),
        *(finish(SuccessJob("lapo", n, 0, tmp_path, 10), {"simulation": 7}) for n in (100, 300)),
    ]
    rows = [row for job in ended for row in job_rows(job, 5, read_status(job.file))]
    page = to_markdown(success_page({**comparison(tmp_path, rows, "slot_bc"), "videos": videos, "seeds": [0]}))
    tables = page.replace("**", "").split("| less Slot BC |")[1:]
    assert len(tables) == (1 if videos else 2)
    for table in tables:
        lines = {line.split("|")[1].strip(): line for line in table.split("\n\n")[0].splitlines() if line[:2] == "| "}
        assert lines["ResNet BC, simulation"].count("+20 (") == (2 if videos else 1)
        assert lines["LAPO, simulation"].count("+30 (") == (2 if videos else 1)


@pytest.mark.integration
def test_the_plot_has_a_panel_for_each_number_of_videos(by_labels: dict[str, Any]) -> None:
    panels = success_figure(by_labels, LIGHT).axes
    assert [axes.get_title() for axes in panels] == ["100 videos", "300 videos"]
    assert all(axes.get_xlabel() == "labelled demonstrations" for axes in panels)
    drawn = [{str(line.get_label()) for line in axes.lines} for axes in panels]
    assert "Slot Oracle" in drawn[1]
    assert "Slot Oracle" not in drawn[0]
    series = [{container.get_label() for container in axes.containers} for axes in panels]
    assert series == [{"PlaySlot", "PlaySlot, imagination", "Slot BC"}] * 2
