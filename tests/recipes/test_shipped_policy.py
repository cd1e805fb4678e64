"""A policy that ships with its world model is evaluated and acts like one that was trained here."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import playslot_rl
from playslot_rl.config.compose import compose
from playslot_rl.errors import CheckpointError, ConfigError
from playslot_rl.recipes import evaluate
from playslot_rl.runs import run as runs

pytestmark = pytest.mark.integration


@pytest.fixture
def shipped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the shipped model in place of the package's folder."""
    home = tmp_path / "shipped"
    shutil.copytree(runs.pretrained_folder("button_press"), home)
    monkeypatch.setattr(runs, "pretrained_folder", lambda env="button_press": home)
    return home


def test_the_models_name_is_the_task() -> None:
    assert compose(["run=pretrained/block_push"], "evaluate").env.blocks.distractors == 3
    assert compose(["run=pretrained/block_push_easy"], "evaluate").env.name == "block_push_easy"
    assert compose(["run=pretrained"], "evaluate").env.name == "button_press"
    assert compose(["run=pretrained", "env=block_push"], "train-policy").env.name == "block_push"
    with pytest.raises(ConfigError, match="env"):
        compose(["run=pretrained/nowhere"], "evaluate")


def test_it_is_evaluated_into_a_run_of_its_own(shipped: Path, tmp_path: Path) -> None:
    before = sorted(path for path in shipped.rglob("*"))
    config = compose(
        ["run=pretrained/button_press", "preset=compact", "episodes=1", "evaluation.references=false",
         f"out={tmp_path / 'check'}"], "evaluate",
    )  # fmt: skip
    evaluate.main(config, report=False)
    result = json.loads((tmp_path / "check" / "evaluation" / "simulation" / "eval_info.json").read_text())
    assert (result["episodes"], result["method"]) == (1, "playslot")
    assert sorted(path for path in shipped.rglob("*")) == before, "nothing is written into the package"
    evaluate.main(replace(config, protocol="imagination"), report=False)
    again = compose([f"run={tmp_path / 'check'}", "episodes=1", "evaluation.references=false"], "evaluate")
    evaluate.main(again, report=False)
    assert playslot_rl.load(tmp_path / "check", "cpu").agent is not None


def test_it_acts(shipped: Path) -> None:
    assert (shipped / "policy").is_dir()
    action = playslot_rl.load("pretrained/button_press", "cpu").act(np.zeros((64, 64, 3), np.uint8))
    assert action.shape == (4,)


def test_what_is_missing_is_one_line(shipped: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"out: got nothing with run=pretrained/button_press, expected a folder"):
        evaluate.main(compose(["run=pretrained/button_press"], "evaluate"))
    shutil.rmtree(shipped / "policy")
    with pytest.raises(CheckpointError, match="is a world model without a policy"):
        evaluate.main(compose(["run=pretrained/button_press", f"out={tmp_path / 'check'}"], "evaluate"))
    assert not (tmp_path / "check").exists()
