"""The model folder: whole or not there, and refused in one line where its files do not belong together."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from contextlib import nullcontext
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from playslot_rl.api import PlaySlot
from playslot_rl.data.cache import cache_folder
from playslot_rl.errors import CheckpointError, OutputError
from playslot_rl.hub import pull
from playslot_rl.sharing.folder import (
    FILES,
    SharedPolicyConfig,
    is_model_folder,
    load_pretrained,
    read_config,
    save_pretrained,
)
from playslot_rl.world_model import Agent

OLD = Path(__file__).parents[1] / "assets" / "policy_of_0_1"


def test_a_saved_policy_comes_back_with_equal_weights_and_config(
    agent: Agent, config: SharedPolicyConfig, folder: Path
) -> None:
    before = torch.random.get_rng_state()
    loaded, read = load_pretrained(folder)
    assert torch.equal(before, torch.random.get_rng_state()), "loading drew from the global generator"
    assert replace(read, fingerprint="") == config
    assert len(read.fingerprint) == 16
    expected = {name: value for name, value in agent.state_dict().items() if not name.startswith("oracle.")}
    got = loaded.state_dict()
    assert got.keys() == expected.keys()
    assert all(torch.equal(got[name], value) for name, value in expected.items())
    assert not loaded.training
    assert not any(parameter.requires_grad for parameter in loaded.parameters())


def test_a_folder_holds_what_lerobot_looks_for_and_no_oracle(folder: Path) -> None:
    assert {path.name for path in folder.iterdir()} == set(FILES)
    assert is_model_folder(folder)
    tensors = load_file(folder / "model.safetensors")
    assert {name.split(".")[1] for name in tensors} == {"world_model", "policy", "action_decoder"}
    values = json.loads((folder / "config.json").read_text())
    assert values["type"] == "playslot"
    assert values["input_features"] == {"observation.images.front": {"type": "VISUAL", "shape": [3, 64, 64]}}
    assert values["output_features"] == {"action": {"type": "ACTION", "shape": [4]}}


def test_a_policy_is_saved_in_the_users_home_and_not_in_a_folder_called_tilde(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    PlaySlot.untrained().save_pretrained("~/press")
    assert is_model_folder(tmp_path / "home" / "press")
    assert not Path("~").exists()


def test_a_commit_that_is_in_the_cache_needs_no_network(folder: Path, tmp_path: Path, monkeypatch: Any) -> None:
    def no_network(*_: Any, **__: Any) -> None:
        raise ConnectionError

    monkeypatch.setattr(pull, "open_repository", no_network)
    commit = "a" * 40
    there = cache_folder(tmp_path / "cache") / "policies" / "me--press" / commit
    shutil.copytree(folder, there)
    assert pull.pull_policy("me/press", commit, tmp_path / "cache") == there
    for moving in ("", "main", "b" * 40):
        with pytest.raises(ConnectionError):
            pull.pull_policy("me/press", moving, tmp_path / "cache")
    (there.parent / "refs").mkdir()
    (there.parent / "refs" / "main").write_text(commit)
    for offline in (True, False):
        monkeypatch.setattr("huggingface_hub.is_offline_mode", lambda offline=offline: offline)
        with nullcontext() if offline else pytest.raises(ConnectionError):  # with a network it may have moved
            assert pull.pull_policy("me/press", "", tmp_path / "cache") == there


def test_saving_twice_gives_equal_files(agent: Agent, config: SharedPolicyConfig, folder: Path, tmp_path: Path) -> None:
    save_pretrained(agent, tmp_path / "again", config, lambda _: "card\n")
    assert all((folder / name).read_bytes() == (tmp_path / "again" / name).read_bytes() for name in FILES)


def edit_tensors(change: Callable[[dict[str, torch.Tensor]], None]) -> Callable[[Path], None]:
    def edit(folder: Path) -> None:
        tensors = load_file(folder / "model.safetensors")
        change(tensors)
        save_file(tensors, folder / "model.safetensors")

    return edit


def edit_config(change: Callable[[dict[str, Any]], None]) -> Callable[[Path], None]:
    def edit(folder: Path) -> None:
        values = json.loads((folder / "config.json").read_text())
        change(values)
        (folder / "config.json").write_text(json.dumps(values))

    return edit


def truncate(folder: Path) -> None:
    path = folder / "model.safetensors"
    path.write_bytes(path.read_bytes()[:1000])


NAME = "agent.action_decoder"


def nudge(tensors: dict[str, torch.Tensor]) -> None:
    name = next(key for key in tensors if key.startswith(NAME))
    tensors[name] = tensors[name] + 1


def drop(tensors: dict[str, torch.Tensor]) -> None:
    del tensors[next(key for key in tensors if key.startswith(NAME))]


def reshape(tensors: dict[str, torch.Tensor]) -> None:
    name = next(key for key in tensors if key.startswith(NAME))
    tensors[name] = torch.zeros(3)


def set_nan(tensors: dict[str, torch.Tensor]) -> None:
    name = next(key for key in tensors if key.startswith(NAME))
    tensors[name].view(-1)[0] = float("nan")


def absurd_header(folder: Path) -> None:
    path = folder / "model.safetensors"
    path.write_bytes((1 << 62).to_bytes(8, "little") + path.read_bytes()[8:])


def grown(folder: Path) -> None:
    """A file of a terabyte that is all holes after the weights."""
    with (folder / "model.safetensors").open("r+b") as file:
        file.truncate(1 << 40)


DAMAGES: dict[str, tuple[Callable[[Path], None], str]] = {
    "other weights": (edit_tensors(nudge), "got fingerprint"),
    "a lost tensor": (edit_tensors(drop), "misses tensor agent.action_decoder"),
    "a foreign tensor": (edit_tensors(lambda t: t.update(x=torch.zeros(1))), "unexpected tensor x"),
    "a misshapen tensor": (edit_tensors(reshape), r"has shape \(3,\), expected"),
    "weights that are NaN": (edit_tensors(set_nan), "holds values that are NaN"),
    "a header of an absurd length": (absurd_header, "header too large"),
    "a terabyte of holes": (grown, "file not fully covered"),
    "another frame size than it says": (
        edit_config(lambda v: v["input_features"]["observation.images.front"].update(shape=[3, 96, 96])),
        "input_features: got shapes",
    ),
    "another action width than it says": (
        edit_config(lambda v: v["output_features"]["action"].update(shape=[7])),
        "output_features: got shapes",
    ),
    "another action width": (edit_config(lambda v: v["env"].update(action_dim=7)), "output_features: got shapes"),
    "features that are a list": (edit_config(lambda v: v.update(input_features=[])), "expected a config of this"),
    "a config of lists in lists": (lambda f: (f / "config.json").write_text("[" * 99999), "is damaged"),
    "no weights": (lambda f: (f / "model.safetensors").unlink(), "model.safetensors is missing"),
    "half a weights file": (truncate, "is damaged"),
    "no config": (lambda f: (f / "config.json").unlink(), "config.json is missing"),
    "half a config": (lambda f: (f / "config.json").write_text("{"), "is damaged"),
    "a run": (lambda f: (f / "config.json").write_text('{"preset": "paper"}'), "got a run, .*: use playslot_rl.load"),
    "another policy": (edit_config(lambda v: v.update(type="act")), "got a policy of type 'act'"),
    "an unknown size": (edit_config(lambda v: v["model"].update(wings=2)), "unknown key model.wings"),
    "no sizes": (edit_config(lambda v: v.pop("model")), "no 'model'"),
    "two cameras": (
        edit_config(lambda v: v["input_features"].update(side={"type": "VISUAL", "shape": [3, 64, 64]})),
        "got 2 cameras",
    ),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_a_damaged_folder_is_refused_in_one_line(folder: Path, name: str) -> None:
    damage, message = DAMAGES[name]
    damage(folder)
    with pytest.raises(CheckpointError, match=message) as raised:
        load_pretrained(folder)
    assert "\n" not in str(raised.value)
    assert "expected" in str(raised.value)


def test_a_policy_exported_by_the_first_version_loads_and_acts_as_then(tmp_path: Path) -> None:
    """Written, and the actions noted, by commit b5f0a66 (version 0.1.0)."""
    import playslot_rl

    assert is_model_folder(OLD)
    assert read_config(OLD).source == {"demos": 3}
    assert read_config(OLD).resize
    model = playslot_rl.PlaySlot.from_pretrained(OLD, device="cpu")
    frame = (np.indices((64, 64)).sum(0)[..., None] * np.array([1, 2, 3]) % 256).astype(np.uint8)
    actions = np.stack([model.act(frame) for _ in range(2)])
    expected = [[0.18600053, 0.04836159, 0.05992724, 0.07526358], [0.18471639, 0.04473947, 0.06127634, 0.07174256]]
    np.testing.assert_allclose(actions, expected, atol=1e-5)
    model.save_pretrained(tmp_path / "again")
    weights = "model.safetensors"
    assert (tmp_path / "again" / weights).read_bytes() == (OLD / weights).read_bytes()


def test_a_recordings_policy_of_an_earlier_version_is_refused(
    agent: Agent, config: SharedPolicyConfig, folder: Path, tmp_path: Path
) -> None:
    robots = tmp_path / "robots"
    save_pretrained(agent, robots, replace(config, env=replace(config.env, name="video")), lambda _: "")
    assert load_pretrained(robots)[1].actions == {}, "actions in [-1, 1] are known to be so"
    values = json.loads((robots / "config.json").read_text())
    del values["actions"]
    (robots / "config.json").write_text(json.dumps(values))
    with pytest.raises(CheckpointError, match=r"clips the robot's actions to \[-1, 1\]: train it again"):
        load_pretrained(robots)
    assert "actions" not in json.loads((folder / "config.json").read_text())


def test_a_missing_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="no such folder"):
        load_pretrained(tmp_path / "none")


def test_what_is_there_already_is_never_replaced(agent: Agent, config: SharedPolicyConfig, tmp_path: Path) -> None:
    (tmp_path / "policy").mkdir()
    (tmp_path / "policy" / "mine").write_text("x")
    with pytest.raises(OutputError, match="there already"):
        save_pretrained(agent, tmp_path / "policy", config, lambda _: "")
    assert [(path.name, path.read_text()) for path in (tmp_path / "policy").iterdir()] == [("mine", "x")]


def test_a_failed_save_leaves_nothing_and_the_next_removes_what_a_kill_left(
    agent: Agent, config: SharedPolicyConfig, tmp_path: Path
) -> None:
    def fail(_: SharedPolicyConfig) -> str:
        raise RuntimeError("in the card")

    with pytest.raises(RuntimeError, match="in the card"):
        save_pretrained(agent, tmp_path / "policy", config, fail)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / ".policy.tmp-0123").mkdir()
    save_pretrained(agent, tmp_path / "policy", config, lambda _: "")
    assert [path.name for path in tmp_path.iterdir()] == ["policy"]


def test_the_front_door_saves_and_loads(agent: Agent, tmp_path: Path) -> None:
    import playslot_rl

    # Frozen, as every loaded agent is: torch multiplies by weights that want gradients in another order.
    frozen = deepcopy(agent).requires_grad_(False)
    model = playslot_rl.PlaySlot(frozen.world_model, frozen)
    frames = torch.rand(2, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    expected = [model.act(frame) for frame in frames]
    model.save_pretrained(tmp_path / "policy")
    for loaded in (
        playslot_rl.PlaySlot.from_pretrained(tmp_path / "policy", device="cpu"),
        playslot_rl.load(tmp_path / "policy", device="cpu"),
    ):
        np.testing.assert_array_equal([loaded.act(frame) for frame in frames], expected)
    again = playslot_rl.load(tmp_path / "policy", device="cpu")
    again.save_pretrained(tmp_path / "again")
    assert read_config(tmp_path / "again") == read_config(tmp_path / "policy")
    with pytest.raises(CheckpointError, match="without a policy"):
        playslot_rl.PlaySlot(agent.world_model).save_pretrained(tmp_path / "none")
