"""The shipped world models: there, small, documented, loadable, and good enough that a broken one is noticed.

The policy in `tests/assets/button_press_policy/policy/checkpoint` was trained on it by `playslot train-policy`; with
another world model it is refused, so that whoever renews the model renews the policy too.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from playslot_rl.config.compose import compose
from playslot_rl.storage.atomic import write_json
from playslot_rl.storage.checkpoints import read_stage
from playslot_rl.training.runs import load_agent, load_world_model, pretrained_folder

ENVS = ("button_press", "block_push_easy", "block_push")
ASSET = Path(__file__).parent / "assets" / "button_press_policy"
LIMIT = 8 * 1000**2


@pytest.fixture(scope="module", params=ENVS)
def shipped(request: pytest.FixtureRequest) -> Path:
    """Its folder. A missing model is a failure, never a skip."""
    return pretrained_folder(request.param)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run that uses the shipped world model with the stored policy."""
    assert (ASSET / "policy" / "checkpoint" / "meta.json").is_file(), f"no stored policy at {ASSET}/policy/checkpoint"
    shutil.copytree(ASSET / "policy" / "checkpoint", tmp_path / "policy" / "checkpoint")
    write_json(tmp_path / "world_model.json", {"source": "pretrained"})
    return tmp_path


def test_the_shipped_model_is_small_and_holds_nothing_else(shipped: Path) -> None:
    files = [path for path in shipped.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < LIMIT
    names = {"weights.safetensors", "config.json", "meta.json"}
    kept = {f"{stage}/checkpoint/{name}" for stage in ("slots", "dynamics") for name in names}
    assert {str(path.relative_to(shipped)) for path in files if path.suffix != ".md"} == kept


@pytest.mark.parametrize("stage", ["slots", "dynamics"])
def test_its_meta_says_how_it_was_made(shipped: Path, stage: str) -> None:
    meta: dict[str, Any] = read_stage(shipped / stage / "checkpoint", stage).meta
    assert len(meta["commit"]) == 40, "expected a commit without local changes"
    assert "pipeline" in meta["command"]
    assert all(len(fingerprint) == 16 for fingerprint in meta["data"].values())
    assert meta["data"]
    assert meta["seconds"] > 1
    assert meta["steps"] > 100
    assert meta["metrics"]
    # Neither a user's folder nor a host's name is published.
    assert "/home/" not in json.dumps(meta)
    assert "/tmp/" not in json.dumps(meta)


def test_no_other_model_ships() -> None:
    assert {path.name for path in pretrained_folder("button_press").parent.iterdir() if path.is_dir()} - {
        "__pycache__"
    } == set(ENVS)


@pytest.mark.parametrize("env", ENVS)
def test_it_loads_and_has_the_sizes_of_the_compact_preset(env: str) -> None:
    world = load_world_model(f"pretrained/{env}")
    config = compose(["preset=compact", f"env={env}"])
    assert world.config.savi == config.model.savi
    assert world.config.inverse_dynamics == config.model.inverse_dynamics
    assert world.config.predictor == config.model.predictor
    assert world.env == config.env


def test_a_stored_policy_presses_the_button_in_simulation(run: Path) -> None:
    from playslot_rl.evaluation.success import evaluate

    agent = load_agent(run)
    config = compose(["preset=compact", "evaluation.references=false", "device=cpu"])
    result = evaluate(agent, config, "simulation", 20, 11)
    assert result["success_rate"] >= 0.8, f"{result['success_rate']:.0%} of 20 episodes, expected at least 80 %"
