"""A robot's actions, in degrees, from LeRobot's writer through training and export to what the robot would get."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from commands import ONE_CORE, Done, playslot, refused, smoke
from robot import CAMERA, CONSTANT, NAMES, OUTLIER, VALUE, edit_stats, ends, meta_of, robot_actions, write_robot

import playslot_rl
from playslot_rl.config.compose import compose
from playslot_rl.data.source import open_sources
from playslot_rl.datasets.adoption import Decisions, for_frames
from playslot_rl.datasets.survey import survey
from playslot_rl.envs.pixel_task import PixelTask
from playslot_rl.sharing.folder import RANGE
from playslot_rl.storage.tensors import load_tensors

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("thin_resnets")]

TASK = ("env=video", "env.action_dim=6")
STATE = ("act_state", "diffusion_state")
ACTIONS = np.concatenate(robot_actions())


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The robot's data set."""
    return write_robot(tmp_path_factory.mktemp("robot") / "set")


@pytest.fixture(scope="module")
def trained(arm: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Done]:
    """A run of all three stages on it, and what the last one said."""
    run = tmp_path_factory.mktemp("arm") / "run"
    smoke("train-slots", *TASK, f"data.root={arm}", f"out={run}")
    smoke("train-dynamics", *TASK, f"data.root={arm}", f"run={run}")
    return run, smoke("train-policy", *TASK, f"data.demos={arm}", f"run={run}", "behaviour.decoder_steps=200")


@pytest.fixture(scope="module")
def unlabelled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Videos of that robot without actions."""
    return write_robot(tmp_path_factory.mktemp("unlabelled") / "bare", labelled=False)


@pytest.fixture(scope="module")
def watched(unlabelled: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with a world model of them, in which nothing says how wide the actions are."""
    run = tmp_path_factory.mktemp("watched") / "run"
    smoke("train-slots", "env=video", f"data.root={unlabelled}", f"out={run}")
    smoke("train-dynamics", f"run={run}")
    return run


@pytest.fixture(scope="module")
def policy(trained: tuple[Path, Done], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its policy, exported."""
    folder = tmp_path_factory.mktemp("policies") / "arm"
    assert playslot("export", f"run={trained[0]}", f"out={folder}", *ONE_CORE).err == ""
    return folder


@pytest.fixture
def frames(arm: Path) -> np.ndarray[Any, Any]:
    """Frames of two episodes, (12, 64, 64, 3)."""
    source = open_sources(arm)
    return np.concatenate([source.frames[:6], source.frames[60:66]])


def acted(model: playslot_rl.PlaySlot, frames: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    model.reset()
    return np.stack([model.act(frame) for frame in frames])


def test_a_world_model_of_unlabelled_videos_gets_a_policy(
    watched: Path, unlabelled: Path, arm: Path, frames: np.ndarray[Any, Any], tmp_path: Path
) -> None:
    few: tuple[str, ...] = ("behaviour.labelled_demos=3", f"data.demos={arm}")
    other = tmp_path / "other"
    for run, own in ((other, ("env.action_dim=6",)), (tmp_path / "mine", ())):
        smoke("train-policy", f"run={watched}", f"out={run}", *few, *own)
        assert json.loads((run / "config.json").read_text())["env"]["action_dim"] == 6
        assert acted(playslot_rl.load(run, device="cpu"), frames).shape == (12, 6)
    assert playslot("export", f"run={other}", f"out={tmp_path / 'policy'}", *ONE_CORE).err == ""
    message = "got actions of width 6, expected 5 as in env.action_dim"
    refused("train-policy", f"run={watched}", f"out={tmp_path / 'no'}", *few, "env.action_dim=5", message=message)
    both = (f"run={watched}", f"data.demos={arm},{unlabelled}")
    done = smoke("train-policy", *both, *few[:1], "behaviour.oracle=false", f"out={tmp_path / 'both'}", "demos=9")
    assert "9 demos, " in done.out
    assert "2 held out (2 without actions)" in done.out
    message = r"bare: got no actions, expected some in all 7 .*: 6 have any"
    few = ("behaviour.labelled_demos=7", "behaviour.oracle=false", f"out={tmp_path / 'no'}")
    refused("train-policy", *both, *few, message=message)
    config = compose([f"data.root={unlabelled}", "env.action_dim=6", f"out={tmp_path / 'adopted'}"], "adopt")
    decide = Decisions(tmp_path / "adopted", {}, 0.0)
    assert for_frames(config, survey(str(unlabelled)), decide).env.action_dim == 6


def test_the_command_says_which_range_it_took(trained: tuple[Path, Done]) -> None:
    run, done = trained
    (line,) = [line for line in done.out.splitlines() if "actions:" in line]
    low, high = ends(meta_of(run, "policy"))
    assert f"{NAMES[0]} {low[0]:.6g}..{high[0]:.6g}" in line
    assert f"{NAMES[CONSTANT]} {VALUE} (constant)" in line
    assert f"{NAMES[OUTLIER]} by quantiles" in line
    assert "% of its values clipped" in line
    plain = [i for i in range(6) if i != OUTLIER]
    assert np.array_equal(low[plain], ACTIONS.min(0)[plain])
    assert np.array_equal(high[plain], ACTIONS.max(0)[plain])
    assert -10 <= low[OUTLIER] < high[OUTLIER] <= 10


def test_the_range_lies_with_the_weights_of_what_acts(trained: tuple[Path, Done]) -> None:
    run, _ = trained
    tensors, (low, high) = load_tensors(run / "policy/checkpoint/weights.safetensors"), ends(meta_of(run, "policy"))
    for network in ("action_decoder", "oracle"):
        assert np.array_equal(tensors[f"{network}.action_range.low"], low)
        assert np.array_equal(tensors[f"{network}.action_range.high"], high)
    assert not any(name.startswith("policy.action_range") for name in tensors)


def test_act_gives_the_robots_units(trained: tuple[Path, Done], frames: np.ndarray[Any, Any]) -> None:
    run, _ = trained
    actions, (low, high) = acted(playslot_rl.load(run, "cpu"), frames), ends(meta_of(run, "policy"))
    assert (np.abs(actions[:, [0, 2, 5]]).max(axis=0) > 1).all()
    assert (actions >= low - 1e-4).all()
    assert (actions <= high + 1e-4).all()
    assert (actions[:, CONSTANT] == np.float32(VALUE)).all()


def test_the_decoder_learns_what_the_robot_did(trained: tuple[Path, Done]) -> None:
    agent = playslot_rl.load(trained[0], "cpu").agent
    assert agent is not None
    decoder = agent.action_decoder
    said = decoder.action_range.from_unit(decoder(torch.zeros(1, *agent.world_model.latent_shape)))
    middle, spread = np.median(ACTIONS, axis=0), ACTIONS.std(axis=0)
    usual = [0, 1, 2, 5]
    assert (np.abs(said[0].detach().numpy() - middle)[usual] < 2 * spread[usual]).all()


def test_lerobot_steps_an_exported_policy_to_the_last_digit(
    policy: Path, frames: np.ndarray[Any, Any], tmp_path: Path
) -> None:
    from lerobot.configs import PreTrainedConfig
    from lerobot.envs import preprocess_observation
    from lerobot.policies import make_pre_post_processors
    from lerobot.policies.factory import get_policy_class

    import lerobot_policy_playslot  # noqa: F401

    config = PreTrainedConfig.from_pretrained(policy)
    network = get_policy_class("playslot").from_pretrained(policy, config=config)
    overrides = {"device_processor": {"device": "cpu"}, "rename_observations_processor": {"rename_map": {}}}
    stored = make_pre_post_processors(config, str(policy), preprocessor_overrides=overrides)
    fresh = make_pre_post_processors(config)
    expected = acted(playslot_rl.PlaySlot.from_pretrained(policy, "cpu"), frames)
    for before, after in (stored, fresh):
        network.reset()
        for frame, wanted in zip(frames, expected, strict=True):
            seen = preprocess_observation({"pixels": {"top": frame[None]}})
            said = network.select_action(before({**seen, "task": [""]}))
            assert said.abs().max() <= 1
            assert np.array_equal(after(said)[0].numpy(), wanted)
    assert (expected[:, CONSTANT] == np.float32(VALUE)).all()
    assert np.abs(expected).max() > 1
    network.save_pretrained(tmp_path)
    fresh[1].save_pretrained(tmp_path, config_filename="policy_postprocessor.json")
    assert (tmp_path / RANGE).read_bytes() == (policy / RANGE).read_bytes()
    assert np.array_equal(acted(playslot_rl.PlaySlot.from_pretrained(tmp_path, "cpu"), frames), expected)


def test_the_run_and_the_exported_policy_give_the_same(
    trained: tuple[Path, Done], policy: Path, frames: np.ndarray[Any, Any], tmp_path: Path
) -> None:
    model = playslot_rl.PlaySlot.from_pretrained(policy, "cpu")
    expected = acted(playslot_rl.load(trained[0], "cpu"), frames)
    assert np.array_equal(acted(model, frames), expected)
    model.save_pretrained(tmp_path / "again")
    assert np.array_equal(acted(playslot_rl.PlaySlot.from_pretrained(tmp_path / "again", "cpu"), frames), expected)
    assert (tmp_path / "again/config.json").read_bytes() == (policy / "config.json").read_bytes()


def test_the_card_names_the_actions_and_their_units(policy: Path) -> None:
    card = (policy / "README.md").read_text()
    assert "[-1, 1]" not in card
    (row,) = [line for line in card.splitlines() if line.startswith("| action |")]
    for name in NAMES:
        assert name in row
    assert f"{NAMES[CONSTANT]} {VALUE} (constant)" in row
    assert "-89.9999..89.9967" in row


def test_an_edited_range_is_refused(policy: Path, tmp_path: Path) -> None:
    shutil.copytree(policy, tmp_path / "edited")
    path = tmp_path / "edited/config.json"
    values = json.loads(path.read_text())
    values["actions"]["high"][0] = 900.0
    path.write_text(json.dumps(values))
    with pytest.raises(playslot_rl.errors.CheckpointError, match=r"got actions in the range .*expected .*\.\.900,"):
        playslot_rl.PlaySlot.from_pretrained(tmp_path / "edited", "cpu")


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A set of a robot with four joints, for the methods that are compared in a simulator, and slots of its frames."""
    root = tmp_path_factory.mktemp("four")
    arm = write_robot(
        root / "set", [episode[:, :4] for episode in robot_actions()], names=NAMES[:4], robot="button_press"
    )
    smoke("train-slots", f"data.root={arm}", f"out={root / 'run'}")
    smoke("train-dynamics", f"data.root={arm}", f"run={root / 'run'}")
    return arm, root / "run"


@pytest.mark.parametrize("method", STATE)
def test_a_robot_without_proprioception_is_refused_where_it_is_read(
    simulated: tuple[Path, Path], tmp_path: Path, method: str
) -> None:
    arm, run = simulated[0], tmp_path / "run"
    refused(
        *("train-baseline", f"method={method}", f"data.demos={arm}", f"out={run}"),
        message=r"got a data set without proprioception, expected the feature `observation\.state`",
    )
    assert not run.exists()


def test_a_simulator_is_stepped_in_the_robots_units(
    simulated: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm, world = simulated
    smoke("train-policy", f"run={world}", f"data.demos={arm}", f"out={tmp_path / 'run'}")
    stepped: list[float] = []

    def step(self: PixelTask, action: Any) -> Any:
        stepped.append(float(action[CONSTANT]))
        return executed(self, action)

    executed = PixelTask.step
    monkeypatch.setattr(PixelTask, "step", step)
    for protocol in ("simulation", "imagination"):
        stepped.clear()
        smoke("evaluate", f"run={tmp_path / 'run'}", "episodes=1", f"protocol={protocol}")
        assert float(np.float32(VALUE)) in stepped, protocol


def test_statistics_that_are_none_change_nothing(trained: tuple[Path, Done], arm: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(arm, tmp_path / "set")
    edit_stats(copy, min=[float("nan")] * 6, max=[float("nan")] * 6, q01=None)
    known = open_sources(copy).limits
    assert known is not None
    assert known.plain() == meta_of(trained[0], "policy")["actions"]
    run = shutil.copytree(trained[0], tmp_path / "run")
    done = smoke("train-policy", *TASK, f"data.demos={copy}", f"run={run}", "behaviour.decoder_steps=200")
    assert "policy: finished before" in done.out


def test_actions_that_are_no_numbers_are_refused_where_they_are_learned(
    trained: tuple[Path, Done], tmp_path: Path
) -> None:
    actions = robot_actions()
    actions[4][7, 2] = np.nan
    broken = write_robot(tmp_path / "set", actions)
    world = (*TASK, f"run={trained[0]}", f"data.demos={broken}", "behaviour.decoder_steps=6")
    message = r"got NaN or infinite actions in 1 of 174 transitions"
    command = ("train-policy", *world, f"out={tmp_path / 'run'}", *ONE_CORE)
    note, error = playslot(*map(str, command)).err.splitlines()
    assert note.startswith("note: ")
    assert re.search(message, error), error
    # Episode 4 is none of the three whose labels are read.
    done = playslot(*map(str, command), "behaviour.oracle=false")
    assert "3 labelled" in done.out, done.err


def test_real_actions_as_latents_are_scaled_and_imagine_takes_them_in_the_robots_units(
    trained: tuple[Path, Done], arm: Path, tmp_path: Path, frames: np.ndarray[Any, Any]
) -> None:
    run, mode = tmp_path / "run", "model.inverse_dynamics.mode=ground_truth"
    shutil.copytree(trained[0] / "slots", run / "slots")
    smoke("train-dynamics", "preset=smoke", *TASK, mode, f"data.root={arm}", f"out={run}")
    smoke("train-policy", "preset=smoke", *TASK, mode, f"data.demos={arm}", f"out={run}")
    model = playslot_rl.load(run, "cpu")
    inverse = model.world_model.inverse_dynamics
    assert np.array_equal(inverse.action_range.low, ends(meta_of(run, "dynamics"))[0])
    z = inverse(torch.zeros(1, 31, *model.world_model.slot_shape), torch.from_numpy(robot_actions()[0])[None]).z
    assert 0.9 < float(z.abs().max()) < 1.01
    real = robot_actions()[0][:3]
    expected = model.imagine(frames[0], torch.from_numpy(real))
    slots = model.parse(frames[0])[None, None]
    assert torch.equal(model.world_model.predictor.rollout(slots, *inverse.split(z[:, :3]))[0], expected)
    assert (acted(model, frames)[:, CONSTANT] == np.float32(VALUE)).all()


def test_a_policy_of_an_earlier_version_is_not_exported_nor_taken_for_a_new_one(
    trained: tuple[Path, Done], arm: Path, tmp_path: Path
) -> None:
    run = shutil.copytree(trained[0], tmp_path / "run")
    path = run / "policy/checkpoint/meta.json"
    meta = json.loads(path.read_text())
    del meta["actions"]
    path.write_text(json.dumps(meta))
    done = playslot("export", f"run={run}", f"out={tmp_path / 'policy'}", *ONE_CORE)
    assert done.code == 1
    assert "clipped the robot's actions to [-1, 1], expected one that knows their range: train it again" in done.err
    refused(
        "train-policy", *TASK, f"data.demos={arm}", f"run={run}", "behaviour.decoder_steps=200",
        message=rf"actions: got {NAMES[0]} .*, expected \[-1, 1\] as .* was trained with: use another out=",
    )  # fmt: skip


def test_our_own_sets_keep_their_actions_and_their_weights(shared_run: Path) -> None:
    assert meta_of(shared_run, "policy")["actions"] is None
    weights = load_tensors(shared_run / "policy/checkpoint/weights.safetensors")
    assert not any("action_range" in name for name in weights)
    assert open_sources(shared_run / "data/expert").limits is None


def test_no_other_camera_is_meant(policy: Path) -> None:
    assert list(json.loads((policy / "config.json").read_text())["input_features"]) == [CAMERA]
