"""Every Gymnasium id, in a fresh interpreter that has imported Gymnasium or TorchRL and nothing of ours."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from playslot_rl.config import EnvConfig
from playslot_rl.config.compose import compose
from playslot_rl.config.families import FAMILIES
from playslot_rl.envs import ENVIRONMENTS, block_ids, dmc_ids, make_env, make_torchrl_env, task_config, task_env
from playslot_rl.errors import ConfigError

pytestmark = pytest.mark.integration

OPTIONAL = {**dict.fromkeys(dmc_ids(), "dm_control"), "PlaySlot/OGBench-v0": "ogbench"}
SUITE = {name for name, package in OPTIONAL.items() if find_spec(package)}
"""Ids of optional packages that are there."""
IDS = sorted({name for name, _ in ENVIRONMENTS.values()} - {"PlaySlot/Gym-v0", *OPTIONAL} | {*block_ids()} | SUITE)
"""All but the one that is nothing without `env.id`."""
NAMES = [f"playslot_rl.envs:{name}" for name in IDS]
SOME = NAMES[:1]

MAKE = "gymnasium.make(name)"
SYNC = "gymnasium.make_vec(name, num_envs=2)"
ASYNC = "gymnasium.make_vec(name, num_envs=2, vectorization_mode='async')"
SERVED = "gymnasium.make_vec(name, 2, 'async', {'context': 'forkserver'})"

PLAY = """
import json, sys
import gymnasium

def main():
    shown = {}
    for name in json.loads(sys.argv[1]):
        env = HOW
        observation, info = env.reset(seed=3)
        env.action_space.seed(0)
        _, reward, *_ = env.step(env.action_space.sample())
        frame = observation["pixels"]
        shown[name] = [list(frame.shape), int(frame.astype(int).sum()), float(getattr(reward, "max", float)())]
        env.close()
    print(json.dumps(shown))

if __name__ == "__main__":
    main()
"""

ROLLOUT = """
import json, sys
from torchrl.envs import GymEnv

shown = {}
for name in json.loads(sys.argv[1]):
    env = GymEnv(name)
    rollout = env.rollout(2)
    shown[name] = [list(rollout["pixels"].shape), str(rollout["pixels"].dtype), list(rollout["next", "reward"].shape)]
    env.close()
print(json.dumps(shown))
"""


def fresh(source: str, names: list[str], folder: Path) -> dict[str, Any]:
    """What a script of its own prints about each name, in an interpreter whose GL backend nobody has chosen."""
    script = folder / "script.py"
    script.write_text(source)
    variables = {key: value for key, value in os.environ.items() if key != "MUJOCO_GL"}
    done = subprocess.run(
        [sys.executable, str(script), json.dumps(names)], env=variables, cwd=folder, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-2000:]
    shown: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return shown


@pytest.mark.parametrize("names", [NAMES[::4], pytest.param(NAMES, marks=pytest.mark.slow)], ids=["some", "all"])
def test_gymnasium_makes_every_id(names: list[str], tmp_path: Path) -> None:
    assert len(NAMES) == 18 + len(SUITE)
    shown = fresh(PLAY.replace("HOW", MAKE), names, tmp_path)
    assert list(shown) == names
    for name, (shape, total, _) in shown.items():
        env = task_env(make_env(task_config_of(name)))
        assert shape == [64, 64, 3]
        assert total == int(env.reset(seed=3)[0]["pixels"].astype(int).sum()), name
        env.close()


def task_config_of(name: str) -> EnvConfig:
    """The task that an id names."""
    found = {**block_ids(), **dmc_ids()}.get(name.partition(":")[2])
    family = next((env for env in FAMILIES if f"/{env}-" in name.lower()), None)
    return task_config(family) if family else EnvConfig() if found is None else found[1]


@pytest.mark.parametrize(
    ("how", "names"),
    [
        (ASYNC, SOME),
        pytest.param(SYNC, NAMES, marks=pytest.mark.slow),
        pytest.param(ASYNC, NAMES, marks=pytest.mark.slow),
        pytest.param(SERVED, SOME, marks=pytest.mark.slow),
    ],
)
def test_gymnasium_makes_several_at_once(how: str, names: list[str], tmp_path: Path) -> None:
    """Each process draws, although the one that starts them has made an environment to read its spaces."""
    shown = fresh(PLAY.replace("HOW", how), names, tmp_path)
    assert sorted(shown) == sorted(names)
    assert all(shape == [2, 64, 64, 3] and total > 0 for shape, total, _ in shown.values())


@pytest.mark.slow
def test_torchrl_makes_every_id(tmp_path: Path) -> None:
    shown = fresh(ROLLOUT, NAMES, tmp_path)
    assert len(shown) == 18 + len(SUITE)
    assert all(seen == [[2, 64, 64, 3], "torch.uint8", [2, 1]] for seen in shown.values())


def test_a_process_forked_from_one_that_draws_is_told_so(tmp_path: Path) -> None:
    """Its driver would wait for the threads of its parent for ever."""
    source = PLAY.replace("HOW", f"({MAKE}.reset(), {ASYNC})[1]")
    source = source.replace(
        "    main()\n", "    try: main()\n    except Exception as error: print(json.dumps(str(error)))\n"
    )
    assert 'vector_kwargs={"context": "forkserver"}' in str(fresh(source, SOME, tmp_path))


def test_ids_without_a_module_work_once_the_package_is_imported(tmp_path: Path) -> None:
    source = PLAY.replace("import gymnasium\n", "import gymnasium\nimport playslot_rl.envs\n")
    shown = fresh(source.replace("HOW", MAKE), ["PlaySlot/BlockPush-v0"], tmp_path)
    assert shown["PlaySlot/BlockPush-v0"][0] == [64, 64, 3]


def test_registering_loads_gymnasium_and_nothing_heavy() -> None:
    code = (
        "import sys, gymnasium\n"
        "from importlib.metadata import entry_points\n"
        "for plugin in entry_points(group='gymnasium.envs'): plugin.load()()\n"
        "print(sum(name.startswith('PlaySlot/') for name in gymnasium.registry), list(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("23 ")
    for heavy in ("torch", "torchrl", "mujoco", "metaworld", "gymnasium_robotics"):
        assert f"'{heavy}'" not in done.stdout


def test_the_plug_in_of_older_gymnasiums_keeps_the_namespace() -> None:
    """They call it inside the namespace that its entry point is named for; `__root__` stands for none."""
    (plugin,) = entry_points(group="gymnasium.envs")
    assert (plugin.name, plugin.value) == ("__root__", "playslot_rl.envs:register")


@pytest.mark.parametrize("name", sorted(ENVIRONMENTS))
def test_a_name_makes_the_task_of_the_command_line(name: str) -> None:
    assert task_config(name) == compose([f"env={name}"]).env


def test_tasks_are_made_by_name() -> None:
    made = make_env("block_push_easy")
    assert task_env(made).config == block_ids()["PlaySlot/BlockPushEasy-v0"][1]
    frame = made.reset(seed=3)[0]["pixels"]
    made.close()
    torchrl = make_torchrl_env("block_push_easy")
    torchrl.set_seed(3)
    np.testing.assert_array_equal(torchrl.reset()["pixels"].permute(1, 2, 0).numpy(), frame)
    torchrl.close()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("buton_press", "did you mean env=button_press"),
        ("grid_shapes", "an environment without a simulator"),
        (3, "env: got int, expected an EnvConfig or a name, one of block_pick"),
    ],
)
def test_what_is_no_task_is_named_in_one_line(given: Any, message: str) -> None:
    for make in (make_env, make_torchrl_env):
        with pytest.raises(ConfigError, match=message) as caught:
            make(given)
        assert "\n" not in str(caught.value)
