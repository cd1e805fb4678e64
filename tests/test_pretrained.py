"""The shipped models: there, small, documented, loadable, and good enough that a broken one is noticed.

Each policy was trained on the world model beside it; with another one it is refused, so that whoever renews the model
renews the policy too.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import playslot_rl
from playslot_rl.config.compose import compose
from playslot_rl.pretrained import episode
from playslot_rl.runs import Run, pretrained_folder
from playslot_rl.storage.checkpoints import read_stage

ENVS = ("button_press", "block_push_easy", "block_push")
STAGES = ("slots", "dynamics", "policy")
LEAST = {"button_press": 0.8, "block_push_easy": 0.7, "block_push": 0.3}
"""Success rate in simulation below which a shipped policy is broken; on 20 episodes, so well below its own."""
LIMIT = 14 * 1000**2


@pytest.fixture(scope="module", params=ENVS)
def shipped(request: pytest.FixtureRequest) -> Path:
    """Its folder. A missing model is a failure, never a skip."""
    return pretrained_folder(request.param)


def test_the_shipped_model_is_small_and_holds_nothing_else(shipped: Path) -> None:
    files = [path for path in shipped.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < LIMIT
    names = {"weights.safetensors", "config.json", "meta.json"}
    kept = {f"{stage}/checkpoint/{name}" for stage in STAGES for name in names}
    assert {str(path.relative_to(shipped)) for path in files if path.suffix != ".md"} == kept


@pytest.mark.parametrize("stage", STAGES)
def test_its_meta_says_how_it_was_made(shipped: Path, stage: str) -> None:
    meta: dict[str, Any] = read_stage(shipped / stage / "checkpoint", stage).meta
    assert len(meta["commit"]) == 40, "expected a commit without local changes"
    assert ("pipeline" in meta["command"]) or stage == "policy"
    assert "labelled_demos" in meta or stage != "policy"
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
    world = Run.open(f"pretrained/{env}").load_world_model()
    config = compose(["preset=compact", f"env={env}"])
    assert world.config.savi == config.model.savi
    assert world.config.inverse_dynamics == config.model.inverse_dynamics
    assert world.config.predictor == config.model.predictor
    assert world.env == config.env


@pytest.mark.parametrize("env", ENVS)
def test_its_policy_was_trained_on_it(env: str) -> None:
    agent = Run.open(f"pretrained/{env}").load_agent()
    assert agent.action_decoder.reads_slots


def test_every_shipped_model_acts() -> None:
    frame = np.zeros((64, 64, 3), np.uint8)
    for name in ("pretrained", *(f"pretrained/{env}" for env in ENVS)):
        action = playslot_rl.load(name, device="cpu").act(frame)
        assert action.shape == (4,)
        assert np.abs(action).max() <= 1.0


@pytest.mark.slow
@pytest.mark.parametrize("env", ENVS)
def test_its_policy_solves_the_task_in_simulation(env: str) -> None:
    from playslot_rl.evaluation.success import evaluate

    config = compose(["preset=compact", f"env={env}", "evaluation.references=false", "device=cpu"])
    result = evaluate(Run.open(f"pretrained/{env}").load_agent(), config, "simulation", 20, 11)
    assert result["success_rate"] >= LEAST[env], f"{result['success_rate']:.0%} of 20 episodes"


@pytest.mark.integration
@pytest.mark.parametrize("env", ENVS)
def test_an_episode_ships_with_each_model_that_it_imagines_from_the_first_frame(env: str) -> None:
    video = episode(env)
    assert video.shape == (21 if env == "button_press" else 26, 64, 64, 3)
    assert video.dtype == np.uint8
    model = playslot_rl.load(f"pretrained/{env}", device="cpu")
    future = model.decode(model.imagine(video[0], model.infer_actions(model.parse(video)).z)).frames.movedim(1, -1)
    error = np.square(video[1:] / 255 - future.numpy()).mean()
    still = np.square(video[1:] / 255 - video[:1] / 255).mean()
    assert error < 0.7 * still


def test_an_episode_of_another_task_is_refused_with_those_that_ship() -> None:
    with pytest.raises(ValueError, match="got 'maze', expected one of block_push, block_push_easy, button_press"):
        episode("maze")
