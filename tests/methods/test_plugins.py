"""Packages bring methods and tasks: those of the tutorials work, and one that fails is one line where it is named."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from commands import playslot

pytestmark = pytest.mark.integration

TUTORIALS = Path(__file__).parents[2] / "docs" / "tutorials"
SCRIPT = """
import contextlib, sys
from playslot_rl.cli import main
for line in sys.stdin.read().splitlines():
    print(f"{line}: {main(line.split())}")
"""


def module_of(page: str) -> str:
    """The Python of a tutorial."""
    [block] = re.findall(r"^```python\n(.*?)^```", (TUTORIALS / page).read_text(), re.DOTALL | re.MULTILINE)
    return block


def install(site: Path, name: str, group: str, points: str, module: str) -> None:
    """What pip leaves of a package of one module."""
    info = site / f"{name}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{group}]\n{points}\n")
    (site / f"{name}.py").write_text(module)


def play(site: Path, *commands: str) -> str:
    """What commands say, one after the other in one process that finds the packages of a folder."""
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT],
        input="\n".join(commands),
        env={**os.environ, "PYTHONPATH": str(site)},
        capture_output=True,
        text=True,
        timeout=280,
        cwd=site,
    )
    return done.stdout + done.stderr


SMOKE = "preset=smoke env=button_press logging.progress=false"


@pytest.fixture(scope="module")
def mine(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A folder with the tutorials' method and task, a method and a task that fail, demonstrations, and runs of the good
    ones and of one of ours; and what was said.
    """
    site = tmp_path_factory.mktemp("mine") / "site"
    for page in ("add-a-method.md", "add-a-task.md"):
        assert len(module_of(page).splitlines()) < 80
    install(site, "mine", "playslot_rl.methods", "mine = mine:MINE", module_of("add-a-method.md"))
    install(site, "reach_dot", "playslot_rl.envs", "reach_dot = reach_dot:TASK", module_of("add-a-task.md"))
    install(site, "broken", "playslot_rl.methods", "broken = broken:METHOD", "raise RuntimeError('no such chip')\n")
    install(site, "odd", "playslot_rl.envs", "odd = odd:TASK", "TASK = 3\n")
    trained = f"train-baseline {SMOKE} method=Mine baselines.mine.width=3 baselines.mine.steps=2 data.demos=demos"
    dot = "preset=smoke env=reach_dot logging.progress=false env.max_steps=20"
    said = play(
        site,
        f"collect {SMOKE} policy=expert episodes=4 out=demos",
        f"{trained} out=run",
        f"{trained} behaviour.loss=l2 out=run",
        f"{trained} behaviour.labelled_demos=3 out=few",
        "evaluate run=run episodes=2",
        f"train-baseline {SMOKE} method=resnet_oracle data.demos=demos out=other",
        f"collect {dot} policy=expert episodes=4 out=dots/demos",
        f"train-slots {dot} data.root=dots/demos out=dots/world",
        f"train-baseline {dot} method=resnet_oracle data.demos=dots/demos out=dots/run",
        "evaluate run=dots/run episodes=4",
        "train-baseline method=broken out=no",
        "collect env=odd out=no",
        "train-baseline method=nothing out=no",
    )
    return site, said


def test_a_method_of_a_package_is_trained_and_evaluated(mine: tuple[Path, str]) -> None:
    site, said = mine
    assert "out=run: 0" in said, said
    assert "behaviour.loss: got l2, expected l1" in said, said
    assert "behaviour.labelled_demos: got 3 with method=mine, which does not read it, expected demos=" in said, said
    stored = json.loads((site / "run" / "mine" / "checkpoint" / "config.json").read_text())
    assert stored["mine"]["width"] == 3
    assert (site / "run" / "evaluation" / "simulation" / "eval_info.json").is_file(), said


def test_a_task_of_a_package_is_recorded_and_learned(mine: tuple[Path, str]) -> None:
    site, said = mine[0] / "dots", mine[1]
    result = json.loads((site / "run" / "evaluation" / "simulation" / "eval_info.json").read_text())
    assert result["episodes"] == 4, said
    stored = json.loads((site / "world" / "slots" / "checkpoint" / "config.json").read_text())
    assert (stored["env"]["name"], stored["env"]["frame_skip"]) == ("reach_dot", 1)


def test_a_package_that_fails_is_one_line_where_it_is_named(mine: tuple[Path, str]) -> None:
    site, said = mine
    assert "broken: got broken:METHOD of the package broken, which fails (RuntimeError: no such chip): repair" in said
    assert "odd: got odd:TASK of the package odd, expected a Task of the name odd" in said, said
    assert "got 'nothing', expected one of playslot, " in said
    assert "Traceback" not in said
    assert not (site / "no").exists()


@pytest.mark.slow
def test_a_method_of_a_package_is_compared(mine: tuple[Path, str]) -> None:
    site, _ = mine
    said = play(
        site,
        f"compare {SMOKE} methods=resnet_oracle,mine baselines.mine.steps=2 data.demos=demos demos=2 seeds=0 "
        "episodes=2 out=compared",
    )
    assert "| mine-d2-s0 | simulation | done |" in (site / "compared" / "comparison.md").read_text(), said


def test_runs_of_other_methods_are_read_without_the_package(
    mine: tuple[Path, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """This process does not find the packages of the folder."""
    site = tmp_path / "site"
    shutil.copytree(mine[0], site, ignore=shutil.ignore_patterns("*.dist-info"))
    monkeypatch.chdir(site)
    done = playslot("evaluate", "run=other", "episodes=2")
    assert (done.code, done.err) == (0, "")
    assert (site / "other" / "evaluation" / "simulation" / "eval_info.json").is_file()
    done = playslot("evaluate", "run=run", "episodes=2")
    assert done.code != 0
    assert "got 'mine', expected one of playslot" in done.err


@pytest.mark.slow
def test_the_pipeline_of_a_task_of_a_package_ends(tmp_path: Path) -> None:
    """It draws itself: nobody knows its parts, and its slots are not scored."""
    site = tmp_path / "site"
    install(site, "reach_dot", "playslot_rl.envs", "reach_dot = reach_dot:TASK", module_of("add-a-task.md"))
    said = play(site, "pipeline preset=smoke env=reach_dot logging.progress=false out=run")
    assert "out=run: 0" in said, said
    assert (site / "run" / "report.html").is_file()
    assert not (site / "run" / "evaluation" / "slots").exists()
