"""SOLD's recipe at preset smoke: trains, resumes, loads, and refuses what does not fit."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from commands import smoke
from safetensors.torch import load_file

from playslot_rl import keys
from playslot_rl.acting.episodes import Moment, TaskPool, run_episodes
from playslot_rl.config import ExperimentConfig, to_dict
from playslot_rl.config.compose import compose
from playslot_rl.errors import CheckpointError, ConfigError
from playslot_rl.methods.sold.acting import load_actor
from playslot_rl.methods.sold.networks import prior_steps
from playslot_rl.methods.training import train
from playslot_rl.modules.savi import SAVi
from playslot_rl.runs import Run
from playslot_rl.storage.checkpoints import checkpoint_folder, save_stage

pytestmark = pytest.mark.integration

FIXED = ("preset=smoke", "method=sold", "device=cpu", "threads=1", "logging.backend=none")


def _config(world: Path, out: Path, *overrides: str) -> ExperimentConfig:
    return compose([*FIXED, f"run={world}", f"out={out}", *overrides])


def _write_world(run: Path, seed: int = 0) -> Path:
    """A run with an untrained SAVi, of six episodes of five agent steps."""
    config = compose(["preset=smoke"])
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        savi = SAVi(config.model.savi, config.env.image_size)
    plain = {"env": to_dict(config.env), "model": to_dict(config.model), "slots": to_dict(config.slots)}
    save_stage(
        checkpoint_folder(run, "slots"), stage="slots", modules={"savi": savi}, config=plain, data={}, parents={},
        metrics={}, steps=1, seconds=0.0, extra={"episodes": 6, "agent_steps": 30},
    )  # fmt: skip
    return run


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _write_world(tmp_path_factory.mktemp("world") / "run")


@pytest.fixture(scope="module")
def trained(world: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished smoke run of SOLD; look, do not touch."""
    run = tmp_path_factory.mktemp("sold") / "run"
    train(_config(world, run))
    return run


def test_a_run_leaves_weights_parents_and_a_learning_curve(trained: Path, world: Path) -> None:
    meta = json.loads((trained / "sold" / "checkpoint" / "meta.json").read_text())
    assert meta["modules"] == ["actor", "critic", "dynamics", "reward"]
    assert meta["parents"] == {"slots": Run.open(world).stage("slots").fingerprint}
    assert json.loads((trained / "config.json").read_text())["method"] == "sold"
    curve = json.loads((trained / "sold" / "curve.json").read_text())
    # 48 agent steps of its own in two points, behind 30 of SAVi's data.
    assert [row["env_steps"] for row in curve["rows"]] == [24 + 30, 48 + 30]
    assert meta["env_steps"] == 78
    assert meta["savi_steps"] == 30
    assert curve["random"]["return_mean"] > 0


def test_the_actor_that_is_loaded_plays_and_repeats(trained: Path) -> None:
    actor = load_actor(Run(trained))
    config = compose(["preset=smoke"])
    chosen: list[np.ndarray] = []

    def noted(moment: Moment) -> None:
        if moment.seen is not None:
            chosen.append(moment.seen[keys.ACTION].numpy())

    with TaskPool(config.env, config.render) as pool:
        for _ in range(2):
            run_episodes(pool, actor, [7, 8], noted, stop=False)
    assert len(chosen) == 2 * config.env.max_steps
    for first, second in zip(chosen[: config.env.max_steps], chosen[config.env.max_steps :], strict=True):
        assert first.shape == (2, 4)
        np.testing.assert_array_equal(first, second)


def test_the_actor_that_is_loaded_has_the_weights_that_were_saved(trained: Path) -> None:
    saved = load_file(trained / "sold" / "checkpoint" / "weights.safetensors")
    loaded = {f"actor.{name}": value for name, value in load_actor(Run(trained)).actor.state_dict().items()}
    assert loaded.keys() == {name for name in saved if name.startswith("actor.")}
    for name, value in loaded.items():
        assert torch.equal(value, saved[name]), name


def test_it_is_evaluated_by_the_evaluator_of_all_methods(trained: Path) -> None:
    smoke("evaluate", f"run={trained}", "episodes=2", "evaluation.references=false")
    info = json.loads((trained / "evaluation" / "simulation" / "eval_info.json").read_text())
    assert info["method"] == "sold"
    assert info["env_steps"] == 78
    assert len(info["per_episode"]) == 2


def test_another_savi_than_it_was_trained_on_is_refused(trained: Path, tmp_path: Path) -> None:
    other = _write_world(tmp_path / "other", seed=1)
    run = Path(shutil.copytree(trained, tmp_path / "run"))
    (run / "world_model.json").write_text(json.dumps({"source": "../other"}))
    with pytest.raises(CheckpointError, match=r"was trained on slots .* got slots"):
        load_actor(Run(run))
    with pytest.raises(CheckpointError, match=r"was trained on slots .* got slots"):
        train(_config(other, run))


def test_networks_of_an_earlier_form_are_refused(trained: Path, world: Path, tmp_path: Path) -> None:
    run = Path(shutil.copytree(trained, tmp_path / "run"))
    path = run / "sold" / "checkpoint" / "config.json"
    stored = json.loads(path.read_text())
    del stored["sold"]["slow_weight"]
    path.write_text(json.dumps(stored))
    with pytest.raises(CheckpointError, match=r"networks of an earlier form .* run train-baseline method=sold with an"):
        load_actor(Run(run))
    with pytest.raises(CheckpointError, match=r"baselines.sold.slow_weight: got 0.1, expected nothing"):
        train(_config(world, run))


def test_a_world_without_slots_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(CheckpointError, match="no slots checkpoint"):
        train(_config(tmp_path / "empty", tmp_path / "run"))
    assert not (tmp_path / "run").exists()


def test_a_task_without_a_dense_reward_is_refused_before_anything_is_written(world: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"env\.blocks\.reward: got sparse with method=sold, expected dense"):
        train(_config(world, tmp_path / "run", "env=block_reach", "env.blocks.reward=sparse"))
    assert not (tmp_path / "run").exists()


def test_another_frame_size_than_savis_is_refused(world: Path, tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"env\.image_size: got 32, expected 64"):
        train(_config(world, tmp_path / "run", "env.image_size=32"))


def test_savis_data_are_counted_from_the_config_the_checkpoint_or_its_episodes(world: Path) -> None:
    own, slots = compose(["preset=smoke"]).baselines.sold, Run.open(world).stage("slots")
    assert prior_steps(own, slots) == 30
    assert prior_steps(compose(["preset=smoke", "baselines.sold.savi_steps=5"]).baselines.sold, slots) == 5
    del slots.meta["agent_steps"]
    assert prior_steps(own, slots) == 6 * 6  # episodes times env.max_steps of preset smoke
    del slots.meta["episodes"]
    with pytest.raises(ConfigError, match=r"baselines.sold.savi_steps: got nothing"):
        prior_steps(own, slots)


@pytest.mark.parametrize(
    "override, message",
    [
        ("heads=3", "heads: got 3, expected a divisor"),
        ("bins=40", "bins: got 40, expected an odd number"),
        ("sequence=2", "sequence: got 2, expected 0, or more than"),
        ("gamma=1.5", r"gamma: got 1.5, expected a number in \[0, 1\]"),
        ("horizon=0", "horizon: got 0, expected at least 1"),
        ("least_context=3", "least_context: got 3, expected at most baselines.sold.context=2"),
    ],
)
def test_settings_that_cannot_be_are_refused(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        compose(["preset=smoke", f"baselines.sold.{override}"])


def test_a_context_that_a_sequence_across_episodes_may_not_hold_is_refused(world: Path, tmp_path: Path) -> None:
    longer = ("env.max_steps=3", "baselines.sold.sequence=6", "baselines.sold.context=4")
    with pytest.raises(ConfigError, match=r"baselines\.sold\.context: got 4, expected at most 3"):
        train(_config(world, tmp_path / "run", *longer))
    assert not (tmp_path / "run").exists()
