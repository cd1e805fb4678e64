"""Finished stages: what is stored, and what is refused."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import torch

from playslot_rl.config import to_dict
from playslot_rl.config.compose import stored_config
from playslot_rl.errors import CheckpointError, ConfigError
from playslot_rl.runs import Run
from playslot_rl.storage.checkpoints import checkpoint_folder, read_stage, require_config, save_stage
from playslot_rl.storage.resume import first_difference
from playslot_rl.storage.tensors import load_tensors, module_tensors, save_tensors, weights_fingerprint
from playslot_rl.testing import tiny_config
from playslot_rl.world_model import Agent, WorldModel


def write_run(run: Path, seed: int = 0, oracle: bool = True) -> Agent:
    """A run with all three stages, untrained."""
    config = tiny_config()
    torch.manual_seed(seed)
    agent = Agent.untrained(WorldModel(config.model, config.env), oracle=oracle)
    world = agent.world_model
    values = to_dict(config)
    common: dict[str, Any] = {"metrics": {"loss": 0.5}, "steps": 3, "seconds": 1.0, "data": {"train": "d" * 16}}
    stored = {"env": values["env"], "model": values["model"]}
    parents: dict[str, str] = {}
    stages = {
        "slots": {"savi": world.savi},
        "dynamics": {"inverse_dynamics": world.inverse_dynamics, "predictor": world.predictor},
        "policy": {"policy": agent.policy, "action_decoder": agent.action_decoder},
    }
    if agent.oracle is not None:
        stages["policy"]["oracle"] = agent.oracle
    for stage, modules in stages.items():
        saved = save_stage(
            checkpoint_folder(run, stage), stage=stage, modules=modules, config=stored, parents=parents, **common
        )
        parents[stage] = saved.fingerprint
    return agent


def edit(path: Path, **changes: object) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def framed(header: object, tensors: bytes = b"") -> bytes:
    text = json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + tensors


TENSOR = {"dtype": "F32", "shape": [2], "data_offsets": [0, 8]}
HEADERS = {
    "no header": b"",
    "half a length": b"\1\0\0",
    "a length of all bits": b"\xff" * 8 + b"{}",
    "a gigabyte in ten bytes": (10**9).to_bytes(8, "little") + b"{}",
    "lists in lists": (200_000).to_bytes(8, "little") + b"[" * 200_000,
    "no table": framed([1]),
    "no tensor": framed({"a": None}),
    "no offsets": framed({"a": TENSOR | {"data_offsets": []}}),
    "offsets below 0": framed({"a": TENSOR | {"data_offsets": [0, -8]}}),
    "terabytes that are not there": framed({"a": TENSOR | {"shape": [2**40], "data_offsets": [0, 2**42]}}),
    "another shape than its bytes": framed({"a": TENSOR | {"shape": [2**40]}}, bytes(8)),
    "another type": framed({"a": TENSOR | {"dtype": "Q9"}}, bytes(8)),
    "more than its tensors": framed({"a": TENSOR}, bytes(9)),
}


@pytest.mark.parametrize("name", HEADERS)
def test_an_absurd_header_is_refused_in_one_line(name: str, tmp_path: Path) -> None:
    path = tmp_path / "weights.safetensors"
    path.write_bytes(HEADERS[name])
    with pytest.raises(CheckpointError, match=r"weights\.safetensors is damaged") as raised:
        load_tensors(path)
    assert "\n" not in str(raised.value)
    path.write_bytes(framed({"a": TENSOR}, bytes(8)))
    assert load_tensors(path)["a"].shape == (2,)


def test_a_file_of_holes_is_refused_by_its_header(tmp_path: Path) -> None:
    path = tmp_path / "weights.safetensors"
    path.write_bytes(framed({"a": TENSOR}, bytes(8)))
    with path.open("r+b") as file:
        file.truncate(1 << 40)
    with pytest.raises(CheckpointError, match="file not fully covered"):
        load_tensors(path)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_that_are_no_numbers_are_refused(value: float, tmp_path: Path) -> None:
    write_run(tmp_path / "run")
    folder = checkpoint_folder(tmp_path / "run", "slots")
    tensors = load_tensors(folder / "weights.safetensors")
    name = next(key for key, tensor in tensors.items() if tensor.is_floating_point())
    tensors[name].view(-1)[0] = value
    save_tensors(folder / "weights.safetensors", tensors)
    edit(folder / "meta.json", fingerprint=weights_fingerprint(folder / "weights.safetensors"))
    with pytest.raises(CheckpointError, match=f"tensor {name} holds values that are NaN or infinite"):
        Run.open(tmp_path / "run").load_savi()


@pytest.fixture(scope="module")
def source_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Agent]:
    folder = tmp_path_factory.mktemp("run")
    return folder, write_run(folder)


@pytest.fixture
def run(source_run: tuple[Path, Agent], tmp_path: Path) -> Path:
    return Path(shutil.copytree(source_run[0], tmp_path / "run"))


def one_line(error: pytest.ExceptionInfo[CheckpointError]) -> bool:
    return "\n" not in str(error.value)


@pytest.mark.parametrize("oracle", [True, False])
def test_an_agent_comes_back_equal_and_frozen(tmp_path: Path, oracle: bool) -> None:
    agent = write_run(tmp_path, oracle=oracle)
    torch.manual_seed(9)
    state = torch.get_rng_state()
    loaded = Run.open(tmp_path).load_agent()
    assert torch.equal(torch.get_rng_state(), state)
    before, after = module_tensors({"agent": agent}), module_tensors({"agent": loaded})
    assert before.keys() == after.keys()
    assert all(torch.equal(before[key], after[key]) for key in before)
    assert not loaded.training
    assert not any(parameter.requires_grad for parameter in loaded.parameters())
    assert (loaded.oracle is not None) == oracle


def test_a_checkpoint_is_three_files_and_says_how_it_was_made(run: Path) -> None:
    folder = checkpoint_folder(run, "policy")
    assert sorted(path.name for path in folder.iterdir()) == ["config.json", "meta.json", "weights.safetensors"]
    checkpoint = read_stage(folder, "policy")
    assert checkpoint.meta["fingerprint"] == checkpoint.fingerprint
    assert checkpoint.meta["parents"].keys() == {"slots", "dynamics"}
    wanted = {"commit", "version", "command", "data", "metrics", "steps", "seconds", "machine", "torch"}
    assert wanted <= checkpoint.meta.keys()
    assert asdict(checkpoint)["config"]["env"]["image_size"] == 64


def test_saving_again_replaces_the_folder(run: Path) -> None:
    first = read_stage(checkpoint_folder(run, "slots"), "slots").fingerprint
    write_run(run, seed=1)
    assert read_stage(checkpoint_folder(run, "slots"), "slots").fingerprint != first
    Run.open(run).load_agent()
    assert [path.name for path in (run / "slots").iterdir()] == ["checkpoint"]


def test_a_child_refuses_a_parent_it_was_not_trained_on(run: Path, tmp_path: Path) -> None:
    write_run(tmp_path / "other", seed=1)
    for stage in ("slots", "dynamics"):
        shutil.rmtree(checkpoint_folder(run, stage))
        shutil.copytree(checkpoint_folder(tmp_path / "other", stage), checkpoint_folder(run, stage))
        with pytest.raises(CheckpointError, match=r"was trained on \w+ [0-9a-f]{16}, got") as caught:
            Run.open(run).load_agent()
        assert one_line(caught)


@pytest.mark.parametrize("name", ["weights.safetensors", "meta.json", "config.json"])
@pytest.mark.parametrize("fault", ["truncated", "missing", "empty"])
def test_a_damaged_file_is_refused(run: Path, name: str, fault: str) -> None:
    path = checkpoint_folder(run, "slots") / name
    if fault == "missing":
        path.unlink()
    else:
        path.write_bytes(path.read_bytes()[:50] if fault == "truncated" else b"")
    with pytest.raises(CheckpointError) as caught:
        Run.open(run).load_savi()
    assert one_line(caught)
    assert str(checkpoint_folder(run, "slots")) in str(caught.value)


@pytest.mark.parametrize("fault", ["missing", "unexpected", "shape", "value"])
def test_wrong_tensors_are_refused(run: Path, fault: str) -> None:
    path = checkpoint_folder(run, "dynamics") / "weights.safetensors"
    tensors = load_tensors(path)
    name = "predictor.embed_slots.weight"
    if fault == "missing":
        del tensors[name]
    elif fault == "unexpected":
        tensors["predictor.more"] = torch.zeros(1)
    elif fault == "shape":
        tensors[name] = tensors[name][:, :3].clone()
    else:
        tensors[name] = tensors[name] + 1
    save_tensors(path, tensors)
    expected = {
        "missing": rf"misses tensor {name}",
        "unexpected": r"unexpected tensor predictor\.more",
        "shape": rf"{name} has shape",
        "value": "was changed or damaged",
    }
    with pytest.raises(CheckpointError, match=expected[fault]) as caught:
        Run.open(run).load_world_model()
    assert one_line(caught)


def test_another_stage_or_format_is_refused(run: Path) -> None:
    with pytest.raises(CheckpointError, match="stage 'slots', expected 'dynamics'"):
        read_stage(checkpoint_folder(run, "slots"), "dynamics")
    edit(checkpoint_folder(run, "slots") / "meta.json", format="other/9")
    with pytest.raises(CheckpointError, match="'other/9'"):
        Run.open(run).load_savi()


def test_a_missing_stage_names_the_command(run: Path, tmp_path: Path) -> None:
    shutil.rmtree(run / "policy")
    with pytest.raises(CheckpointError, match="playslot train-policy"):
        Run.open(run).load_agent()
    with pytest.raises(CheckpointError, match="no such folder"):
        Run.open(tmp_path / "nowhere").load_agent()
    with pytest.raises(CheckpointError, match="no such folder"):
        Run.open("")


def test_a_data_set_is_no_run_and_a_home_is_found(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "set" / "meta").mkdir(parents=True)
    (tmp_path / "set" / "meta" / "info.json").write_text("{}")
    for refuses, error in ((Run.open, CheckpointError), (stored_config, ConfigError)):
        with pytest.raises(error, match="got a data set, expected the folder of a run"):
            refuses(tmp_path / "set")
    monkeypatch.setenv("HOME", str(run.parent))
    assert Run.open(f"~/{run.name}").folder == run


def test_a_changed_config_names_the_key(run: Path) -> None:
    slots = read_stage(checkpoint_folder(run, "slots"), "slots")
    model = to_dict(tiny_config())["model"]
    require_config(slots, {"model": {"savi": model["savi"]}})
    model["savi"]["slot_dim"] = 48
    with pytest.raises(CheckpointError, match=r"^model\.savi\.slot_dim: got 48, expected 32") as caught:
        require_config(slots, {"model": {"savi": model["savi"]}})
    assert one_line(caught)


def test_a_task_that_is_compared_whole_is_compared_in_what_is_unsaid(run: Path) -> None:
    """A policy that learned by acting under a variation is none of the plain task."""
    path, env = checkpoint_folder(run, "slots"), to_dict(tiny_config())["env"]
    require_config(read_stage(path, "slots"), {"env": env})
    edit(path / "config.json", env={**env, "variation": {"shake": 0.5}})
    varied = read_stage(path, "slots")
    require_config(varied, {"env": {"image_size": env["image_size"]}})
    with pytest.raises(CheckpointError, match=r"^env\.variation\.shake: got nothing, expected 0\.5"):
        require_config(varied, {"env": env})


def test_a_savi_is_compared_in_what_is_unsaid(run: Path) -> None:
    path, model = checkpoint_folder(run, "slots"), to_dict(tiny_config())["model"]
    assert "decoder_start" not in model["savi"]
    edit(path / "config.json", model={**model, "savi": {**model["savi"], "decoder_start": 16}})
    with pytest.raises(CheckpointError, match=r"^model\.savi\.decoder_start: got nothing, expected 16"):
        require_config(read_stage(path, "slots"), {"model": {"savi": model["savi"]}})


def test_a_world_model_from_before_predictors_had_a_kind_is_cocvps() -> None:
    wanted = {"model": {"predictor": to_dict(tiny_config())["model"]["predictor"]}}
    old = {"model": {"predictor": {key: v for key, v in wanted["model"]["predictor"].items() if key != "kind"}}}
    assert first_difference(old, wanted) is None
    wanted["model"]["predictor"]["kind"] = "ocvp_seq"
    assert first_difference(old, wanted) == ("model.predictor.kind", "cocvp", "ocvp_seq")


def test_a_policy_from_before_whitening_and_decoders_that_read_slots_loads(
    run: Path, source_run: tuple[Path, Agent]
) -> None:
    later = {"policy": ("whiten",), "action_decoder": ("whiten", "reads_slots")}
    for stage in ("slots", "dynamics", "policy"):
        path = checkpoint_folder(run, stage) / "config.json"
        model = json.loads(path.read_text())["model"]
        for part, names in later.items():
            for name in (*names, *(key for key in list(model[part]) if key.startswith("state_"))):
                del model[part][name]
        edit(path, model=model)
    old, trained = Run.open(run).load_agent(), source_run[1].eval()
    slots = torch.randn(2, *trained.world_model.slot_shape)
    z = old.policy(slots)
    torch.testing.assert_close(z, trained.policy(slots))
    torch.testing.assert_close(old.action_decoder(z, slots), trained.action_decoder(z))


def test_a_config_of_another_version_is_refused(run: Path) -> None:
    edit(checkpoint_folder(run, "slots") / "config.json", model={"savi": {"slot_dimension": 3}})
    with pytest.raises(CheckpointError, match="unknown key"):
        Run.open(run).load_savi()


def test_a_run_may_use_the_world_model_of_another(run: Path, tmp_path: Path) -> None:
    child = tmp_path / "child"
    shutil.copytree(run / "policy", child / "policy")
    with pytest.raises(CheckpointError, match="no slots checkpoint"):
        Run.open(child).load_agent()
    Run(child).build_on(Run.open(run))
    assert json.loads((child / "world_model.json").read_text()) == {"source": "../run"}
    assert Run.open(child).world_run.folder.resolve() == run.resolve()
    Run.open(child).load_agent()
    alone = shutil.copytree(child, tmp_path / "elsewhere" / "child")
    there = tmp_path / "elsewhere" / "run"
    with pytest.raises(
        CheckpointError, match=rf"got no world model, expected it at {there} \(world_model.json\): copy"
    ):
        Run.open(alone).load_agent()
    (child / "world_model.json").write_text("{}")
    with pytest.raises(CheckpointError, match='no "source"'):
        Run.open(child).load_agent()
