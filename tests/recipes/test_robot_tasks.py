"""A robot's own set of several tasks: policies that are told which, in the set's words, by every method that clones."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from commands import ONE_CORE, instead, playslot, refused, smoke
from robot import CAMERA, write_robot
from tensordict import TensorDict

import playslot_rl
from playslot_rl import keys
from playslot_rl.acting.closed_loop import ClosedLoop
from playslot_rl.config import EnvConfig
from playslot_rl.config.methods import METHODS, cloning_methods
from playslot_rl.config.plugins import call
from playslot_rl.runs import Run

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("thin_resnets")]

OPEN, CLOSE = "Open the drawer.", "Close the drawer, slowly."
VIDEO = ("env=video", "env.action_dim=6", "data.held_out=2")
TOLD = (*VIDEO, f"env.task={OPEN} + {CLOSE}")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A set of two tasks, one after the other, and a world model of its videos; the last of each are held out."""
    base = tmp_path_factory.mktemp("kitchen")
    root, run = write_robot(base / "set", tasks=(OPEN, CLOSE), states=True), base / "run"
    smoke("train-slots", *TOLD, f"data.root={root}", f"out={run}")
    smoke("train-dynamics", f"run={run}")
    return root, run


def test_from_a_set_of_two_tasks_to_a_robot_that_is_told(recorded: tuple[Path, Path], tmp_path: Path) -> None:
    from lerobot.policies import make_pre_post_processors

    from lerobot_policy_playslot.modeling_playslot import PlaySlotPolicy

    (root, world), run, folder = recorded, tmp_path / "run", tmp_path / "policy"
    smoke("train-policy", *TOLD, f"run={world}", f"data.demos={root}", f"out={run}", "behaviour.labelled_demos=2")
    assert "actions" in smoke("evaluate", f"run={run}", "protocol=actions").out
    smoke("export", f"run={run}", f"out={folder}")
    card = (folder / "README.md").read_text()
    assert f"| {OPEN}; {CLOSE} |" in card
    assert f"policy.reset(task={json.dumps(OPEN)})" in card
    assert f'"{CAMERA}": picture, "task": {json.dumps(OPEN)}' in card
    assert f"`--task='{OPEN}'`" in card
    assert f"'env.task={OPEN} + {CLOSE}'" in card

    frame = np.random.default_rng(0).integers(256, size=(64, 64, 3), dtype=np.uint8)
    models, shared = [playslot_rl.load(path) for path in (run, folder)], PlaySlotPolicy.from_pretrained(folder)
    before, after = make_pre_post_processors(shared.config, str(folder))
    picture, acted = torch.from_numpy(frame).movedim(-1, 0).float() / 255, []
    for task in (OPEN, CLOSE):
        shared.reset()
        found = [after(shared.select_action(before({CAMERA: picture, "task": task})))[0].numpy()]
        for model in models:
            model.reset(task=task)
            found.append(model.act(frame))
        np.testing.assert_allclose(found[1:], [found[0]] * 2, rtol=1e-5)
        acted.append(found[0])
    assert not np.allclose(*acted, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("method", cloning_methods())
def test_every_method_that_clones_is_told(method: str, recorded: tuple[Path, Path], tmp_path: Path) -> None:
    (root, world), own, run = recorded, METHODS[method], tmp_path / "run"
    typed = [*TOLD, f"data.root={root}", f"data.demos={root}", f"out={run}", *([f"run={world}"] if own.slots else [])]
    typed += ["behaviour.labelled_demos=2"] if own.some_labelled else []
    smoke("train-policy" if method == "playslot" else "train-baseline", *typed, f"method={method}")
    assert "actions" in smoke("evaluate", f"run={run}", "protocol=actions").out
    actor = call(own.load.actor, Run(run), torch.device("cpu"))
    actor.tells = lambda _: torch.tensor([[0], [1], [0]])
    loop = ClosedLoop(actor)
    loop.reset([0, 0, 0])  # the same noise for Diffusion Policy
    seen = {keys.PIXELS: torch.rand(1, 3, 64, 64).expand(3, -1, -1, -1), keys.STATE: torch.rand(1, 6).expand(3, -1)}
    actions = loop.step(TensorDict(seen, [3]))[keys.ACTION]
    assert (actions[0] - actions[1]).abs().max() > 1e-5
    torch.testing.assert_close(actions[0], actions[2])


def test_what_a_policy_was_told_belongs_to_it(recorded: tuple[Path, Path], tmp_path: Path) -> None:
    (root, world), out = recorded, f"out={tmp_path / 'run'}"
    train = ("train-policy", f"run={world}", f"data.demos={root}", "data.held_out=2", out, "behaviour.labelled_demos=2")
    smoke(*train)  # as its world model's run says
    assert Run(tmp_path / "run").config.env.sentences == (OPEN, CLOSE)
    assert "skipped" in smoke(*train).out
    refused(*train, f"env.task={CLOSE}+{OPEN}", message=r"env\.task: got Close .*, expected Open .*: use another out=")
    assert playslot(*instead((*train, "preset=smoke", *ONE_CORE), "env.task=")).code == 1
    untold = f"out={tmp_path / 'untold'}"
    assert playslot(*instead((*train, "preset=smoke", *ONE_CORE), untold, "env.task=")).code == 0
    refused("evaluate", f"run={tmp_path / 'untold'}", "protocol=actions", message="train .* with data.held_out=2")


def test_tasks_that_no_set_names_are_refused(recorded: tuple[Path, Path], tmp_path: Path) -> None:
    root, world = recorded
    train = ("train-policy", *VIDEO, f"run={world}", f"data.demos={root}", f"out={tmp_path / 'run'}")
    refused(*train, f"env.task={OPEN}+Dance.", message=r"got demonstrations of 'Close .*, expected .* name it, too")
    refused(*train, f"env.task={OPEN}", message=r"got 'Open the drawer\.', expected none with env\.name=video", code=2)
    for wrong in ("Dance.", "+", f"{OPEN}+", f"{OPEN}+{OPEN}"):
        with pytest.raises(ValueError, match=r"expected none with env\.name=video, or several that the sets name"):
            EnvConfig(name="video", task=wrong)
