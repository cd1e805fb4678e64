"""The error of actions on held-out demonstrations of a robot that no simulator knows: every method, in degrees."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from commands import ONE_CORE, playslot, refused, smoke
from robot import LENGTH, NAMES, ends, meta_of, robot_actions, write_robot
from tensordict import TensorDict

from playslot_rl.acting.closed_loop import ClosedLoop
from playslot_rl.config import plugins
from playslot_rl.config.methods import METHODS, cloning_methods, method_stage
from playslot_rl.data.source import open_sources
from playslot_rl.runs import Run

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("thin_resnets")]


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The robot's data set, without proprioception."""
    return write_robot(tmp_path_factory.mktemp("robot") / "set")


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A set of the robot with proprioception, and a run with a world model that was not shown its last two episodes."""
    root = tmp_path_factory.mktemp("kept")
    arm, run = write_robot(root / "set", states=True), root / "run"
    smoke("train-slots", "env=video", f"data.root={arm}", "data.held_out=2", f"out={run}")
    smoke("train-dynamics", f"run={run}")
    return arm, run


@pytest.mark.parametrize("method", cloning_methods())
def test_every_method_learns_and_is_measured_without_a_simulator_in_the_robots_units(
    kept: tuple[Path, Path], tmp_path: Path, method: str
) -> None:
    (arm, world), run, kind = kept, tmp_path / "run", METHODS[method]
    task = ["preset=smoke", "env=video", f"method={method}"] if method != "playslot" else []
    command = ("train-baseline" if task else "train-policy", *task, f"data.demos={arm}", "data.held_out=2")
    command = (*command, f"out={run}", *[f"run={world}"] * (kind.slots or not task))
    done, stage = smoke(*command), method_stage(method)
    assert f"{stage}: actions: {NAMES[0]} " in done.out
    assert "finished before" in smoke(*command).out
    actor = plugins.call(kind.load.actor, Run.open(run))
    low, high = ends(meta_of(run, stage))
    known = actor.action_range
    assert np.array_equal(known.low, low)
    assert np.array_equal(known.high, high)

    said = smoke("evaluate", "protocol=actions", f"run={run}").out
    result = json.loads((run / "evaluation/actions/eval_info.json").read_text())
    assert (result["method"], result["episodes"], result["rows"]) == (method, 2, 2 * (LENGTH - 1))
    # By hand: one episode alone, frame by frame, as a robot would be told.
    errors, source = [], open_sources(arm)
    actor.eval()
    for number, episode in enumerate((4, 5)):
        loop = ClosedLoop(actor)
        loop.reset([number])
        for row in source.episode_rows(episode)[:-1]:
            seen = TensorDict({"pixels": source.pixels([row]), "state_vector": torch.tensor(source.states[[row]])}, [1])
            action = actor.executed(loop.step(seen)["action"])[0].numpy()
            assert (low - 1e-3 <= action).all()
            assert (action <= high + 1e-3).all()
            errors.append(action - source.actions[row])
    by_hand = np.abs(errors).mean(axis=0)
    measured = [row["mae"] for row in result["per_dimension"]]
    assert np.allclose(measured, by_hand, rtol=1e-3, atol=1e-3)
    assert result["mae"] == pytest.approx(by_hand.mean(), rel=1e-3)
    assert [row["name"] for row in result["per_dimension"]] == NAMES
    assert result["references"]["constant"]["r2"] == 0
    assert result["references"]["constant"]["mae"] > 10, "degrees"
    assert f"error {result['mae']:.3g} (" in said
    assert result["untold"] == []


def test_what_was_trained_on_is_not_measured_on(kept: tuple[Path, Path], arm: Path, tmp_path: Path) -> None:
    few, copy, run = ("env=video", "method=resnet_bc"), write_robot(tmp_path / "copy"), tmp_path / "run"
    other = write_robot(tmp_path / "other", [episode + 1 for episode in robot_actions()])
    smoke("train-baseline", *few, f"data.demos={arm}", f"out={run}")
    measure = ("evaluate", "protocol=actions", f"run={run}")
    refused(*measure, message="data.held_out: got 0, and a policy that was trained on all of")
    message = "got 6 of 6 episodes that resnet_oracle was trained on, expected none: name another set by data.demos="
    refused(*measure, f"data.demos={copy}", message=message)
    assert "6 held-out episodes, 174 actions of " in smoke(*measure, f"data.demos={other}").out

    world, policy = tmp_path / "world", tmp_path / "policy"
    smoke("train-slots", "env=video", f"data.root={arm}", f"out={world}")
    again = (
        "train-slots",
        "preset=smoke",
        "env=video",
        f"data.root={arm}",
        f"out={world}",
        "data.held_out=2",
        *ONE_CORE,
    )
    done = playslot(*again)
    assert "slots: finished before" in done.out
    assert done.err == "note: slots: got data.held_out=2, but was trained with 0\n"
    slots = ("env=video", "method=slot_bc", f"run={world}", f"data.demos={arm}", "data.held_out=2")
    smoke("train-baseline", *slots, f"out={policy}")
    message = r"got \d of 2 episodes that slots was trained on, expected none: train slots with data.held_out=2, too"
    refused("evaluate", "protocol=actions", f"run={policy}", message=message)
    refused("evaluate", f"run={policy}", message="protocol: got simulation with env=video, .* expected actions")


def test_methods_are_compared_without_a_simulator(kept: tuple[Path, Path], tmp_path: Path, started: list[str]) -> None:
    (arm, world), out = kept, tmp_path / "out"
    given = ("env=video", f"data.demos={arm}", "methods=playslot,slot_bc,resnet_bc", "labels=2,3", "demos=4", "seeds=0")
    command = ("compare", *given, f"run={world}", f"out={out}")
    done = smoke(*command)
    assert len(started) == 6
    result = json.loads((out / "comparison.json").read_text())
    rows = {(row["method"], row["labels"]): row for row in result["rows"]}
    assert len(rows) == 6
    for (_, labels), row in rows.items():
        assert (row["status"], row["protocol"], row["episodes"]) == ("done", "actions", 2)
        assert row["labelled_demos"] == labels
        assert row["mae"] > 0
        assert row["rmse"] >= row["mae"]
        assert row["r2"] < 1
        assert row["references"] == rows["playslot", labels]["references"], "one constant for all of so many labels"
    assert rows["playslot", 2]["references"]["constant"]["mae"] != rows["playslot", 3]["references"]["constant"]["mae"]
    table = [line for line in done.out.splitlines() if line.startswith("|")]
    assert [word.strip() for word in table[0].split("|")] == ["", "error of actions", "2 labelled", "3 labelled", ""]
    names = ["Slot BC", "ResNet BC", "PlaySlot", "(mean labelled action)", "(action of the step before)"]
    assert [line.split("|")[1].strip() for line in table[2:7]] == names
    assert [line.split("|")[1].strip() for line in table[7:]] == ["less PlaySlot", "---", "Slot BC", "ResNet BC"]
    apart = {(row["method"], row["labels"]): row for row in result["differences"]}
    assert apart.keys() == rows.keys() - {("playslot", 2), ("playslot", 3)}
    for (method, labels), row in apart.items():
        assert row["difference"] == pytest.approx(rows[method, labels]["mae"] - rows["playslot", labels]["mae"])
        assert row["better"] in (None, row["difference"] < 0)
    assert f"{rows['resnet_bc', 3]['mae']:.3g} (" in table[3]
    started.clear()
    assert smoke(*command).out.count("done before, skipped") == 6
    assert not started
    elsewhere = ("compare", *given, f"out={tmp_path / 'no'}")
    message = "got 1 of 3 episodes that slots, dynamics were trained on, .*: train slots, dynamics with data.held_out=3"
    refused(*elsewhere, f"run={world}", "data.held_out=3", "demos=3", message=message)
    refused(*elsewhere, f"run={world}", "methods=resnet_bc,dreamer", message="got dreamer, which learns by acting")
    refused(*elsewhere, f"run={world}", "demos=5", message=r"demos: got 5, expected at most the 4 demonstrations")


def test_methods_that_act_say_what_works_without_a_simulator(arm: Path, tmp_path: Path) -> None:
    for method in (name for name, kind in METHODS.items() if kind.online):
        command = ("train-baseline", "env=video", f"method={method}", f"data.demos={arm}", f"out={tmp_path / 'run'}")
        own = [f"run={tmp_path}"] * METHODS[method].slots
        (tmp_path / "config.json").write_text("{}")
        refused(*command, *own, message=f"got {method}, which learns by acting, .*: playslot, slot_oracle")
