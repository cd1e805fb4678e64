"""`playslot inspect`: the card on disk, its page, its place in the report, and bad input."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from commands import Done, contents, playslot, refused, smoke
from foreign import foreign_frames

from playslot_rl.evaluation.card_lines import MEASURES

pytestmark = pytest.mark.integration


def written(run: Path) -> dict[str, object]:
    stored: dict[str, object] = json.loads((run / "inspect" / "inspect.json").read_text())
    return stored


def test_a_pipelines_run_has_a_card_and_its_report_a_section(pipeline: tuple[Path, Done]) -> None:
    run, said = pipeline
    stored = written(run)
    lines = stored["lines"]
    assert isinstance(lines, list)
    assert [one["key"] for one in lines] == list(MEASURES)
    assert all(one["good"] and one["bad"] for one in lines)
    assert stored["held_out_known"] is True
    assert "report card: " in said.out
    page, report = (run / "inspect" / "inspect.md").read_text(), (run / "report.md").read_text()
    for one in lines:
        assert one["measure"] in page
        assert one["measure"] in report
    named = re.findall(r"\]\((figures/[a-z_]+\.png)\)", page)
    assert {"figures/slots.png", "figures/held.png", "figures/codebook.png"} <= set(named)
    assert all((run / "inspect" / name).stat().st_size > 500 for name in named)
    assert str(run) not in page


@pytest.mark.slow
def test_a_demo_has_a_card_of_its_demonstrations_and_its_report_a_section(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    arguments = ("preset=smoke", "env.max_steps=8", "collect.expert_steps=8", f"out={out}", "episodes=2", "workers=1")
    said = playslot("demo", *arguments)
    assert said.code == 0, said.err
    assert written(out)["data"] == "expert"
    assert "report card: " in said.out
    report = (out / "report.md").read_text()
    section = report.partition("## Report card")[2].partition("\n## ")[0]
    assert all(measure.name in section for measure in MEASURES.values())
    shutil.rmtree(out / "inspect")  # as a demo of an earlier version left it: the card is made, the report renewed
    (out / "report.md").write_text("")
    again = playslot("demo", *arguments)
    assert again.code == 0, again.err
    assert "measured before" in again.out
    assert section == (out / "report.md").read_text().partition("## Report card")[2].partition("\n## ")[0]


def test_a_report_without_a_card_names_data_that_are_there(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(run.parent)
    shutil.rmtree(run / "inspect")
    smoke("evaluate", "run=run", "protocol=imagination", "episodes=1")
    command = re.search(r"`playslot (inspect run=run data\.root=run/data/expert)`", (run / "report.md").read_text())
    assert command is not None
    smoke(*command[1].split())
    assert written(run)["data"] == "expert"


def test_a_card_repeats_and_follows_the_set(run: Path, demos: Path) -> None:
    smoke("inspect", f"run={run}", f"data.root={demos}")
    first = written(run)
    smoke("inspect", f"run={run}", f"data.root={demos}")
    second = written(run)
    changing = {"wall_seconds", "hardware"}
    assert {k: v for k, v in first.items() if k not in changing} == {
        k: v for k, v in second.items() if k not in changing
    }
    assert first["data"] == "expert"


def test_a_shipped_model_is_inspected_into_a_run_of_its_own(tmp_path: Path, videos: Path) -> None:
    arguments = ("run=pretrained", f"data.root={videos}", "episodes=4", f"out={tmp_path / 'new'}")
    smoke("inspect", *arguments)
    assert written(tmp_path / "new")["run"] == "pretrained"
    smoke("inspect", *arguments)  # into the same one


def test_the_report_says_how_to_make_a_card_that_is_missing(run: Path) -> None:
    from playslot_rl.visualization.report import write_report

    shutil.rmtree(run / "inspect")
    shutil.rmtree(run / "dynamics")
    write_report(run)
    text = (run / "report.md").read_text()
    assert "There is no report card of the world model yet." in text
    assert "playslot inspect run=" in text


def write_videos(root: Path, size: int = 64, length: int = 4, camera: bool = True, still: bool = False) -> Path:
    """A LeRobot set without actions, written by LeRobot itself."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    image = {"dtype": "image", "shape": (size, size, 3), "names": ["height", "width", "channels"]}
    features = {"observation.images.top": image} if camera else {}
    features["observation.state"] = {"dtype": "float32", "shape": (2,), "names": None}
    dataset = LeRobotDataset.create("me/videos", fps=10, features=features, root=root, use_videos=False)
    frames = foreign_frames(size)[2]
    for _ in range(3):
        for t in range(length):
            row = {"observation.state": np.zeros(2, np.float32), "task": "look"}
            dataset.add_frame(row | ({"observation.images.top": frames[0 if still else t]} if camera else {}))
        dataset.save_episode(parallel_encoding=False)
    dataset.finalize()
    return root


def test_a_set_without_actions_is_measured_without_them(run: Path, tmp_path: Path) -> None:
    done = smoke("inspect", f"run={run}", f"data.root={write_videos(tmp_path / 'set')}")
    assert "linear_probe:       not measured: no actions" in done.out
    lines = written(run)["lines"]
    assert isinstance(lines, list)
    notes = {one["key"]: (one["verdict"], one["note"]) for one in lines}
    assert notes["mlp_probe"] == ("not measured", "no actions")
    assert notes["moving_explained"][0] != "not measured"
    assert done.out.splitlines()[-1].startswith("verdict: not usable: ")  # six steps


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"camera": False}, "camera"),
        ({"length": 1}, "got 3 episodes of one frame, expected some of two frames or more"),
        ({"still": True}, "got frames that never change"),
        ({"size": 32}, "got frames of 32x32 from observation.images.top, expected 64x64"),
    ],
)
def test_videos_that_cannot_be_inspected_are_refused_and_nothing_is_written(
    run: Path, tmp_path: Path, changes: dict[str, int], message: str
) -> None:
    before = contents(run)
    root = write_videos(tmp_path / "set", **changes)  # type: ignore[arg-type]
    refused("inspect", f"run={run}", f"data.root={root}", message=message)
    assert contents(run) == before
