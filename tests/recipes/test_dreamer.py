"""`train-baseline method=dreamer` at smoke size: what it leaves, what it refuses, kill -9."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from commands import instead, killed_at_first_checkpoint

from playslot_rl.acting.episodes import Moment, TaskPool, run_episodes
from playslot_rl.config.compose import compose
from playslot_rl.errors import CheckpointError, ConfigError
from playslot_rl.methods import training
from playslot_rl.methods.dreamer.networks import load_actor
from playslot_rl.recipes import train_baseline
from playslot_rl.runs import Run

pytestmark = pytest.mark.integration

SMOKE = ("preset=smoke", "method=dreamer", "env=block_reach", "threads=1", "device=cpu", "env.max_steps=6")


def train(out: Path, *overrides: str) -> None:
    """The recipe, as the command line calls it."""
    train_baseline.main(compose([*SMOKE, f"out={out}", *overrides]))


def weights(out: Path) -> bytes:
    return (out / "dreamer" / "checkpoint" / "weights.safetensors").read_bytes()


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("dreamer") / "run"
    train(out)
    return out


def test_a_run_leaves_weights_a_curve_and_its_config(run: Path) -> None:
    meta = json.loads((run / "dreamer" / "checkpoint" / "meta.json").read_text())
    assert meta["stage"] == "dreamer"
    assert meta["env_steps"] == 36
    assert meta["steps"] == 1 + 24 // 4
    assert meta["parameters"] > 0
    curve = json.loads((run / "dreamer" / "curve.json").read_text())
    assert [row["env_steps"] for row in curve["rows"]] == [12, 24, 36]
    for theme in ("light", "dark"):
        assert (run / "dreamer" / f"curve_{theme}.png").read_bytes().startswith(b"\x89PNG")
    assert json.loads((run / "config.json").read_text())["method"] == "dreamer"
    assert {path.name for path in run.iterdir()} == {"config.json", "dreamer"}


def test_its_actor_plays_and_repeats_itself(run: Path) -> None:
    actor = load_actor(Run(run))
    config = compose(list(SMOKE))
    seeds = [1_000_000_000, 1_000_000_001]
    shown: list[list[int]] = [[], []]
    with TaskPool(config.env, config.render) as pool:
        for take in shown:

            def look_on(moment: Moment, take: list[int] = take) -> None:
                take.extend(hash(frame.tobytes()) for frame in moment.frames)

            torch.rand(3)  # the global generator is none of its business
            run_episodes(pool, actor, seeds, look_on, stop=False)
    assert len(shown[0]) == 14
    assert shown[0] == shown[1]


def test_a_run_without_an_actor_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="no dreamer checkpoint"):
        load_actor(Run(tmp_path))


@pytest.mark.parametrize(
    "override, message",
    [
        ("env.blocks.reward=sparse", "env.blocks.reward: got sparse with method=dreamer, expected dense"),
        ("env=grid_shapes", "env=grid_shapes: got an environment without a simulator"),
        ("baselines.dreamer.steps=100000000", "steps: got .* episodes, expected at most"),
        ("baselines.dreamer.frame_size=24", "frame_size: got 24, expected a divisor"),
        ("baselines.dreamer.capacity=5", "capacity: got 5 frames, expected at least"),
    ],
)
def test_what_cannot_be_learned_from_is_refused_before_anything_is_written(
    tmp_path: Path, override: str, message: str
) -> None:
    config = compose(list(map(str, instead(SMOKE, f"out={tmp_path / 'run'}", override))))
    with pytest.raises(ConfigError, match=message):
        training.train(config)
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_a_killed_run_with_workers_ends_with_the_weights_of_one_that_was_not(tmp_path: Path) -> None:
    workers = ("baselines.dreamer.envs=2", "baselines.dreamer.workers=2")
    train(tmp_path / "whole", *workers)
    killed_at_first_checkpoint(
        tmp_path / "killed" / "dreamer", "train-baseline", *SMOKE, *workers, f"out={tmp_path / 'killed'}"
    )
    train(tmp_path / "killed", *workers)
    assert weights(tmp_path / "killed") == weights(tmp_path / "whole")
