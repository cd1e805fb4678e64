"""GridShapes end to end: collected, trained without a policy, scored against what is known, and streamed."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from commands import ONE_CORE, playslot, refused

from playslot_rl.collectors.journal import CollectionSpec
from playslot_rl.config import EnvConfig, GridConfig
from playslot_rl.config.compose import compose
from playslot_rl.data.source import open_sources
from playslot_rl.envs.grid_shapes import generate, moves_of

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def shapes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished smoke run."""
    run = tmp_path_factory.mktemp("shapes") / "run"
    done = playslot("pipeline", "env=grid_shapes", "preset=smoke", f"out={run}", "episodes=4", *ONE_CORE)
    assert done.code == 0, done.err
    return run


def test_the_pipeline_scores_slots_and_latents_and_trains_no_policy(shapes: Path) -> None:
    result = json.loads((shapes / "evaluation" / "objects" / "eval_info.json").read_text())
    assert -1 <= result["foreground_ari"] <= 1
    assert set(result["probes"]) == {"prototype", "latent"}
    assert result["probes"]["prototype"]["chance"] == 0.2
    assert np.sum(result["codes"]) == 4 * 6 * 2, "each object's slot has one code a step"
    assert not (shapes / "policy").exists()
    assert sorted(path.name for path in (shapes / "data").iterdir()) == ["random"]


def test_its_report_has_the_scores_and_misses_nothing(shapes: Path) -> None:
    text = (shapes / "report.md").read_text()
    for part in ("FG-ARI", "from the slot's prototype", "| up |", "most frequent move", "Prediction"):
        assert part in text
    assert "To make it" not in text
    assert {"prediction.png", "slots.png", "prototypes.png", "losses.png"} <= {
        path.name for path in (shapes / "figures").iterdir()
    }


def test_the_same_command_again_skips_everything(shapes: Path) -> None:
    done = playslot("pipeline", "env=grid_shapes", "preset=smoke", f"out={shapes}", "episodes=4", *ONE_CORE)
    assert done.code == 0
    assert done.out.count("skipped") == 4


def test_evaluate_says_that_there_is_nothing_to_act_on(shapes: Path) -> None:
    done = playslot("evaluate", f"run={shapes}", "protocol=imagination", "episodes=2", "seed=1", *ONE_CORE)
    assert done.code == 0
    assert "nothing to act on" in done.out
    refused("evaluate", f"run={shapes}", "episodes=1", message="episodes: got 1, expected at least 2")
    refused("train-policy", f"run={shapes}", message="variant: got multi, expected single")


def test_models_learn_from_clips_that_are_drawn_for_every_batch(shapes: Path, tmp_path: Path) -> None:
    wanted = ("env=grid_shapes", "preset=smoke", "data.drawn=true", f"data.root={shapes / 'data' / 'random'}")
    drawn, run = "objects=2, size=15, speed=2, change=0.25", tmp_path / "run"
    for stage in ("slots", "dynamics"):
        command = (f"train-{stage}", *wanted, f"out={run}", *ONE_CORE)
        done = playslot(*command)
        assert done.code == 0, done.err
        assert json.loads((run / stage / "checkpoint" / "meta.json").read_text())["drawn"] == drawn
        assert "finished before" in playslot(*command).out
        refused(*command, "env.grid.speed=3", message=f"got {drawn.replace('speed=2', 'speed=3')}, expected {drawn}")
    refused("train-slots", *wanted, f"out={shapes}", message=f"data.drawn: got {drawn}, expected false as")


def test_collected_clips_are_those_of_their_seeds(tmp_path: Path) -> None:
    wanted = ("env=grid_shapes", "env.grid.objects=3", "env.action_dim=6", "episodes=3", "collect.random_steps=5")
    done = playslot("collect", *wanted, "seed=2", f"out={tmp_path / 'set'}", *ONE_CORE)
    assert done.code == 0, done.err
    source = open_sources(tmp_path / "set", cache=tmp_path / "cache")
    assert source.seeds is not None
    assert source.actions is not None
    assert source.seeds.tolist() == [2_000_000, 2_000_001, 2_000_002]
    clips = generate(source.seeds.tolist(), 5, EnvConfig(name="grid_shapes", action_dim=6, grid=GridConfig(objects=3)))
    for episode in range(3):
        rows = source.episode_rows(episode)
        np.testing.assert_array_equal(source.frames[rows], clips.frames[episode])
        np.testing.assert_array_equal(moves_of(source.actions[rows[:-1]]), clips.moves[episode])


def test_a_record_without_the_groups_of_other_tasks_is_the_same_collection() -> None:
    plain = CollectionSpec.make(compose(["preset=smoke"]), "random", 2, 3, 0).to_dict()
    assert not [value for value in plain["env"].values() if isinstance(value, dict)], "as it was before there were any"
    shapes = ["preset=smoke", "env=grid_shapes", "env.grid.speed=3"]
    assert CollectionSpec.make(compose(shapes), "random", 2, 3, 0).to_dict()["env"]["grid"]["speed"] == 3
