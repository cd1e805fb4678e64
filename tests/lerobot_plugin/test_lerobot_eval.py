"""LeRobot's own `lerobot-eval` on the stored policy and the shipped world model."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from playslot_rl.config.compose import compose
from playslot_rl.envs import task_config
from playslot_rl.evaluation.success import evaluate
from playslot_rl.runs import Run
from playslot_rl.sharing.folder import SharedPolicyConfig, save_pretrained
from playslot_rl.sharing.run import export_run
from playslot_rl.storage.atomic import write_json
from playslot_rl.testing import tiny_agent, tiny_config

pytestmark = pytest.mark.slow  # a process that imports all of LeRobot

SHIPPED = Path(__file__).parents[2] / "playslot_rl" / "pretrained" / "button_press"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with the stored policy."""
    root = tmp_path_factory.mktemp("run")
    shutil.copytree(SHIPPED / "policy" / "checkpoint", root / "policy" / "checkpoint")
    write_json(root / "world_model.json", {"source": "pretrained"})
    return root


def lerobot_eval(policy: Path, out: Path, *arguments: str, task: str = "button_press") -> dict[str, Any]:
    """Run it as a user would; what it wrote."""
    program = Path(sys.executable).with_name("lerobot-eval")
    command = [str(program), f"--policy.path={policy}", "--env.type=playslot", f"--env.task={task}",
               f"--output_dir={out}", "--policy.device=cpu", *arguments]  # fmt: skip
    environment = {**os.environ, "HF_HUB_OFFLINE": "1"}
    environment.pop("MUJOCO_GL", None)  # users do not set it
    done = subprocess.run(command, cwd=out.parent, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    info: dict[str, Any] = json.loads((out / "eval_info.json").read_text())
    return info


@pytest.mark.parametrize("side_by_side", [1, 2])
def test_lerobot_eval_measures_what_our_evaluation_measures(run: Path, tmp_path: Path, side_by_side: int) -> None:
    config = compose(["preset=compact", "evaluation.references=false", "device=cpu"])
    ours = evaluate(Run.open(run).load_agent(), config, "simulation", 2, 0)
    export_run(Run.open(run), tmp_path / "policy", config)
    info = lerobot_eval(
        tmp_path / "policy", tmp_path / "eval", "--eval.n_episodes=2", f"--eval.batch_size={side_by_side}",
        "--eval.use_async_envs=false", f"--seed={ours['seeds'][0]}",
    )  # fmt: skip
    assert ours["redrawn"] == 0, "the same seeds on both sides"
    (group,) = info["per_task"]
    assert group["task_group"] == "button_press"
    assert group["metrics"]["successes"] == [episode["success"] for episode in ours["per_episode"]]
    assert info["overall"]["n_episodes"] == 2
    assert info["overall"]["pc_success"] == 100 * ours["success_rate"]
    assert all((tmp_path / path).is_file() for path in info["overall"]["video_paths"])
    assert len(info["overall"]["video_paths"]) == 2


def test_lerobot_eval_tells_a_policy_of_several_tasks_which(tmp_path: Path) -> None:
    """One that is told nothing, or in other words, raises."""
    task = "metaworld/reach+drawer-open"
    agent = tiny_agent(replace(tiny_config(), env=task_config(task)))
    shared = SharedPolicyConfig(env=agent.world_model.env, model=agent.world_model.config)
    save_pretrained(agent, tmp_path / "policy", shared, lambda _: "card\n")
    info = lerobot_eval(
        tmp_path / "policy", tmp_path / "eval", "--eval.n_episodes=4", "--eval.batch_size=2", "--env.episode_length=3",
        "--eval.use_async_envs=false", "--seed=1000000000", task=task,
    )  # fmt: skip
    assert info["overall"]["n_episodes"] == 4
