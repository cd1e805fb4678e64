"""The front door."""

from __future__ import annotations

import doctest
import importlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import playslot_rl
from playslot_rl import api
from playslot_rl.api import PlaySlot
from playslot_rl.config import to_dict
from playslot_rl.errors import CheckpointError, ConfigError
from playslot_rl.storage.checkpoints import checkpoint_folder, save_stage
from playslot_rl.testing import tiny_config
from playslot_rl.world_model import Agent


@pytest.fixture(scope="module")
def model() -> PlaySlot:
    return PlaySlot.untrained()


@pytest.fixture(scope="module")
def video() -> np.ndarray:
    return np.random.default_rng(0).integers(256, size=(5, 64, 64, 3), dtype=np.uint8)


def test_frames_are_accepted_as_they_come(model: PlaySlot, video: np.ndarray) -> None:
    tensor = torch.from_numpy(video)
    layouts = [video, tensor, tensor.movedim(-1, 1), tensor.float() / 255, video.transpose(0, 3, 1, 2) / 255.0]
    expected, *others = (model.parse(frames) for frames in layouts)
    assert expected.shape == (5, 4, 32)
    for slots in others:
        torch.testing.assert_close(slots, expected, atol=1e-5, rtol=1e-5)


def test_a_frame_and_a_batch_of_clips_are_parsed_like_a_clip(model: PlaySlot, video: np.ndarray) -> None:
    slots = model.parse(video)
    torch.testing.assert_close(model.parse(video[0]), slots[0], atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(model.parse(np.stack([video, video])), torch.stack([slots, slots]), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(
    "frames, message",
    [
        (np.zeros((5, 32, 32, 3), np.uint8), r"got shape \(5, 32, 32, 3\), expected \(\.\.\., 64, 64, 3\)"),
        (np.full((64, 64, 3), 200.0), r"in \[200, 200\], expected uint8 in \[0, 255\] or floats in \[0, 1\]"),
        (np.full((64, 64, 3), np.nan), r"expected uint8 in \[0, 255\] or floats in \[0, 1\]"),
        (np.zeros((64, 64, 3), np.int64), r"got torch.int64"),
        (np.zeros((1, 1, 1, 64, 64, 3), np.uint8), r"got 6 dimensions"),
    ],
)
def test_other_frames_are_refused(model: PlaySlot, frames: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        model.parse(frames)


def test_latent_actions_of_a_clip_are_those_of_the_batch(model: PlaySlot, video: np.ndarray) -> None:
    slots = model.parse(video)
    single, batch = model.infer_actions(slots), model.infer_actions(slots[None])
    assert single.z.shape == (4, 8)
    assert torch.equal(single.z, batch.z[0])
    assert torch.equal(single.code, batch.code[0])
    with pytest.raises(ValueError, match="at least 2 frames"):
        model.infer_actions(slots[:1])
    with pytest.raises(ValueError, match=r"expected \(\.\.\., 4, 32\)"):
        model.infer_actions(slots[..., :16])


def test_imagining_is_the_predictors_rollout(model: PlaySlot, video: np.ndarray) -> None:
    slots = model.parse(video)
    z = model.infer_actions(slots).z
    future = model.imagine(video[0], z)
    p, v = model.world_model.inverse_dynamics.split(z[None])
    expected = model.world_model.predictor.rollout(slots[None, :1], p, v)[0]
    torch.testing.assert_close(future, expected, atol=1e-5, rtol=1e-5)
    both = model.imagine(np.stack([video[0], video[1]]), torch.stack([z, z]))
    torch.testing.assert_close(both[0], future, atol=1e-5, rtol=1e-5)
    many = model.imagine(video[0], torch.stack([z, -z]))
    torch.testing.assert_close(many[0], future, atol=1e-5, rtol=1e-5)
    assert not torch.allclose(many[0], many[1])
    assert model.decode(future).frames.shape == (4, 3, 64, 64)


def test_prototypes_can_be_played_by_number(model: PlaySlot, video: np.ndarray) -> None:
    numbers = np.array([0, 3, 3])
    by_value = model.imagine(video[0], model.world_model.inverse_dynamics.prototypes[torch.from_numpy(numbers)])
    torch.testing.assert_close(model.imagine(video[0], numbers), by_value)
    with pytest.raises(ValueError, match=r"got prototypes \[0, 5\], expected 0 to 4"):
        model.imagine(video[0], np.array([0, 5]))
    continuous = PlaySlot.untrained(tiny_config("continuous"))
    with pytest.raises(ValueError, match="has no prototypes"):
        continuous.imagine(video[0], numbers)


@pytest.mark.parametrize("shape", [(8,), (3, 7), (2, 2, 2, 8), (0, 8)])
def test_actions_of_another_shape_are_refused(model: PlaySlot, video: np.ndarray, shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"expected \(\[B,\] P, 8\)"):
        model.imagine(video[0], torch.zeros(shape))
    with pytest.raises(ValueError, match=r"expected equal numbers|one frame for each"):
        model.imagine(video[:2], torch.zeros(3, 4, 8))


def test_acting_carries_savis_state_until_reset(model: PlaySlot, video: np.ndarray) -> None:
    assert model.agent is not None
    model.reset()
    acted = torch.from_numpy(np.stack([model.act(frame) for frame in video]))
    with torch.no_grad():
        expected = model.agent.action_decoder(model.agent.policy(model.parse(video)))
    torch.testing.assert_close(acted, expected, atol=1e-5, rtol=1e-5)
    model.reset()
    np.testing.assert_allclose(model.act(video[0]), acted[0], atol=1e-5)
    with pytest.raises(ValueError, match="expected one frame"):
        model.act(video)


def test_a_world_model_alone_refuses_to_act(model: PlaySlot, video: np.ndarray) -> None:
    with pytest.raises(CheckpointError, match="without a policy"):
        PlaySlot(model.world_model).act(video[0])


def test_nothing_is_trained_and_nothing_random_is_left_to_chance(video: np.ndarray) -> None:
    config = tiny_config()
    savi = replace(config.model.savi, initial="gaussian")
    gaussian = PlaySlot.untrained(replace(config, model=replace(config.model, savi=savi)))
    before = {name: tensor.clone() for name, tensor in gaussian.world_model.state_dict().items()}
    first, second = gaussian.parse(video), gaussian.parse(video)
    assert torch.equal(first, second)
    assert not first.requires_grad
    gaussian.imagine(video[0], gaussian.infer_actions(first).z)
    assert all(torch.equal(before[name], t) for name, t in gaussian.world_model.state_dict().items())


def write_stages(run: Path, agent: Agent, stages: tuple[str, ...]) -> None:
    config = tiny_config()
    plain = {"env": to_dict(config.env), "model": to_dict(config.model)}
    world = agent.world_model
    modules = {
        "slots": {"savi": world.savi},
        "dynamics": {"inverse_dynamics": world.inverse_dynamics, "predictor": world.predictor},
        "policy": {"policy": agent.policy, "action_decoder": agent.action_decoder},
    }
    parents: dict[str, str] = {}
    for stage in stages:
        saved = save_stage(
            checkpoint_folder(run, stage),
            stage=stage,
            modules=modules[stage],
            config=plain,
            data={},
            parents=parents,
            metrics={},
            steps=1,
            seconds=0.0,
        )
        parents = {**parents, stage: saved.fingerprint}


def test_a_run_folder_is_loaded_with_what_it_has(model: PlaySlot, video: np.ndarray, tmp_path: Path) -> None:
    assert model.agent is not None
    write_stages(tmp_path / "world", model.agent, ("slots", "dynamics"))
    write_stages(tmp_path / "whole", model.agent, ("slots", "dynamics", "policy"))
    world, whole = playslot_rl.load(tmp_path / "world", "cpu"), playslot_rl.load(str(tmp_path / "whole"), "cpu")
    torch.testing.assert_close(world.parse(video), model.parse(video))
    with pytest.raises(CheckpointError, match="without a policy"):
        world.act(video[0])
    model.reset()
    np.testing.assert_allclose(whole.act(video[0]), model.act(video[0]), atol=1e-6)
    with pytest.raises(CheckpointError, match="no such folder"):
        playslot_rl.load(tmp_path / "missing")


@pytest.mark.parametrize(
    "module",
    [
        "api",
        "acting.actor",
        "acting.imagination",
        "acting.simulation",
        "testing",
        "world_model",
        "losses.slots",
        "losses.dynamics",
        "losses.behaviour",
    ],
)
def test_docstring_examples_run(module: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from importlib.resources import files

    monkeypatch.setenv("MUJOCO_GL", "egl")
    loaded = importlib.import_module(f"playslot_rl.{module}")
    if module == "api" and not (files("playslot_rl.pretrained") / "button_press").is_dir():
        monkeypatch.setattr(api.load, "__doc__", "")  # its example loads the shipped model
    result = doctest.testmod(loaded, optionflags=doctest.NORMALIZE_WHITESPACE)
    assert result.attempted > 0
    assert result.failed == 0


WRONG = ["x.mp4", b"x", Path("x.mp4"), None, ["a", "b"], [[1, 2], [3]], object(), {"a": 1}, Image.new("RGB", (64, 64)),
         np.array(["a"]), np.zeros((64, 64, 3), object), np.zeros((64, 64, 3), complex)]  # fmt: skip


@pytest.mark.parametrize("wrong", WRONG, ids=lambda wrong: type(wrong).__name__)
def test_what_holds_no_numbers_is_refused_in_one_line(model: PlaySlot, video: np.ndarray, wrong: object) -> None:
    calls: dict[str, Callable[[], object]] = {
        "frames": lambda: model.parse(wrong),  # type: ignore[arg-type]
        "slots": lambda: model.infer_actions(wrong),  # type: ignore[arg-type]
        "slots ": lambda: model.decode(wrong),  # type: ignore[arg-type]
        "actions": lambda: model.imagine(video[0], wrong),  # type: ignore[arg-type]
        "frames ": lambda: model.imagine(wrong, torch.zeros(2, dtype=torch.long)),  # type: ignore[arg-type]
        "frames  ": lambda: model.act(wrong),  # type: ignore[arg-type]
        "batch_size": lambda: model.imagination(wrong),  # type: ignore[arg-type]
    }
    for what, call in calls.items():
        with pytest.raises(TypeError, match=f"^{what.strip()}: got .*, expected ") as caught:
            call()
        assert "\n" not in str(caught.value)
        assert len(str(caught.value)) < 250


@pytest.mark.parametrize("wrong", [5, 5.0, True, torch.zeros(0, 64, 64, 3), torch.zeros(0, 3, 64, 64, dtype=torch.int8),
                                   np.zeros((64, 64, 3), np.uint16), np.zeros((64, 64, 3), bool)])  # fmt: skip
def test_numbers_that_are_no_frames_are_refused_in_one_line(model: PlaySlot, wrong: object) -> None:
    for call in (model.parse, model.act):
        with pytest.raises(ValueError, match=r"^frames: got .*, expected ") as caught:
            call(wrong)  # type: ignore[arg-type]
        assert "\n" not in str(caught.value)


def test_slots_are_floats(model: PlaySlot, video: np.ndarray) -> None:
    slots = model.parse(video)
    for call in (model.infer_actions, model.decode):
        with pytest.raises(ValueError, match=r"^slots: got torch\.int64, expected floats"):
            call(slots.long())
        with pytest.raises(ValueError, match=r"^slots: got shape \(0, 4, 32\)"):
            call(slots[:0])
    torch.testing.assert_close(model.decode(slots.numpy()).frames, model.decode(slots.double()).frames)


def test_frames_may_be_reversed(model: PlaySlot, video: np.ndarray) -> None:
    torch.testing.assert_close(model.parse(video[::-1]), model.parse(video[::-1].copy()))


def test_the_simulator_of_a_policy_of_every_second_frame_takes_steps_twice_as_long(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from playslot_rl.acting import simulation
    from playslot_rl.sharing.folder import SharedPolicyConfig

    monkeypatch.setattr(simulation, "make_simulation_env", lambda env, *_: env)
    model = PlaySlot.untrained()
    known: Any = model.simulation()
    model._policy = SharedPolicyConfig(stride=2)
    slow: Any = model.simulation()
    assert (slow.frame_skip, slow.max_steps) == (2 * known.frame_skip, known.max_steps // 2)


@pytest.mark.parametrize("wrong", [5, None, ["runs/a"], True, {1}], ids=str)
def test_names_of_another_type_are_refused_in_one_line(model: PlaySlot, wrong: object) -> None:
    calls: dict[str, Callable[[], object]] = {
        "run": lambda: playslot_rl.load(wrong),  # type: ignore[arg-type]
        "name": lambda: PlaySlot.from_pretrained(wrong),  # type: ignore[arg-type]
        "folder": lambda: model.save_pretrained(wrong),  # type: ignore[arg-type]
        "device": lambda: playslot_rl.load("pretrained", device=wrong),  # type: ignore[arg-type]
    }
    if wrong is not None:
        calls["render"] = lambda: model.simulation(wrong)  # type: ignore[arg-type]
        calls["config"] = lambda: PlaySlot.untrained(wrong)  # type: ignore[arg-type]
    if wrong != 5:
        calls["seed"] = lambda: playslot_rl.load("pretrained", seed=wrong)  # type: ignore[arg-type]
        calls["horizon"] = lambda: model.imagination([2], wrong)  # type: ignore[arg-type]
    for what, call in calls.items():
        with pytest.raises(TypeError, match=f"^{what}: got .*, expected ") as caught:
            call()
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("device", ["meta", "gpu", "cuda:99", "cpu:x"])
def test_a_device_that_computes_nothing_is_refused(device: str) -> None:
    with pytest.raises(ConfigError, match=f"^device={device}: .*; use device=cpu$"):
        playslot_rl.load("pretrained", device=device)


@pytest.mark.parametrize("sizes", [[-1], [0], [2.5], [[2]]])
def test_a_batch_of_imagined_episodes_has_whole_sizes(model: PlaySlot, sizes: object) -> None:
    with pytest.raises(ValueError, match=r"^batch_size: got .*, expected numbers from 1 on"):
        model.imagination(sizes)  # type: ignore[arg-type]


def test_imagination_has_the_reward_that_it_is_given(model: PlaySlot) -> None:
    rollout = model.imagination([2], reward=lambda slots: slots.sum(dim=(-2, -1))[..., None]).rollout(3)
    torch.testing.assert_close(rollout["next", "reward"][..., 0], rollout["next", "slots"].sum(dim=(-2, -1)))
