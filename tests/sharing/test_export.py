"""`playslot export`: a whole folder with a truthful card, or one line of what is wrong."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml
from commands import ONE_CORE, Done, contents, playslot, refused

from playslot_rl.config import to_dict
from playslot_rl.config.compose import compose
from playslot_rl.evaluation.success import task_facts
from playslot_rl.recipes.play import open_studio
from playslot_rl.runs import Run
from playslot_rl.sharing.commands import reproduce
from playslot_rl.sharing.folder import read_config
from playslot_rl.sharing.run import read_source
from playslot_rl.storage.atomic import write_json

pytestmark = pytest.mark.integration


def evaluated(run: Path, protocol: str, **changes: Any) -> dict[str, Any]:
    """Store a result of this run's policy."""
    info = {
        "protocol": protocol, "episodes": 50, "seed": 0, "success_rate": 0.98, "ci95": [0.895, 0.996],
        "mean_steps_to_success": 14.5, "fingerprints": read_source(Run.open(run))["fingerprints"],
        "references": {"random": {"success_rate": 0.0, "ci95": [0.0, 0.07]},
                       "slot_oracle": {"success_rate": None, "ci95": None}},
    } | task_facts(Run.open(run).config, 0) | changes  # fmt: skip
    write_json(run / "evaluation" / protocol / "eval_info.json", info)
    return info


def exported(run: Path, out: Path) -> str:
    """Export; the card."""
    done = playslot("export", f"run={run}", f"out={out}", *ONE_CORE)
    assert (done.code, done.err) == (0, ""), done.err
    return (out / "README.md").read_text()


def test_a_run_becomes_a_folder_and_stays_as_it_was(run: Path, tmp_path: Path) -> None:
    before = contents(run)
    exported(run, tmp_path / "policies" / "press")
    assert contents(run) == before
    config = read_config(tmp_path / "policies" / "press")
    stored = json.loads((run / "policy" / "checkpoint" / "meta.json").read_text())
    assert config.source["fingerprints"] == {**stored["parents"], "policy": stored["fingerprint"]}
    assert (config.source["demos"], config.source["labelled_demos"]) == (150, 10)
    assert config.source["shipped_world_model"]
    assert config.camera == "observation.images.front"


def test_a_shipped_policy_becomes_a_folder_too(tmp_path: Path) -> None:
    assert playslot("export", "run=pretrained/button_press", f"out={tmp_path / 'press'}").code == 0
    assert read_config(tmp_path / "press").source["labelled_demos"] == 10


def test_the_card_tells_task_data_results_limits_and_versions(run: Path, tmp_path: Path) -> None:
    evaluated(run, "simulation")
    card = exported(run, tmp_path / "press")
    header = yaml.safe_load(card.split("---")[1])
    assert header["license"] == "apache-2.0"
    assert header["library_name"] == "lerobot"
    assert {"lerobot", "robotics", "playslot", "button_press"} <= set(header["tags"])
    assert "| task | Press the red button. |" in card
    assert "4 numbers in [-1, 1]: hand displacement x, y, z and gripper effort" in card
    assert "`observation.images.front`, 64 x 64 RGB" in card
    assert "real actions of 10 demonstrations" in card
    meta = json.loads((run / "policy" / "checkpoint" / "meta.json").read_text())
    assert meta["data"]["demos"] in card, "fingerprint of the demonstrations"
    assert "| this policy, in simulation (closed loop) | 98 % | 90 to 100 % | 14.5 | 50 | 0 |" in card
    assert "| random actions | 0 % | 0 to 7 % |" in card
    assert "slot oracle" not in card, "it was not measured"
    assert "ICML 2025" in card
    assert re.search(r"exported with \| playslot_rl \S+, torch \S+, .*lerobot 0\.6\.1", card)
    assert read_config(tmp_path / "press").fingerprint in card


def test_the_card_names_no_folder_of_this_machine(run: Path, tmp_path: Path) -> None:
    path = run / "policy" / "checkpoint" / "meta.json"
    meta = json.loads(path.read_text())
    write_json(path, meta | {"command": "playslot demo out=/home/someone/x", "data_root": "/home/someone/data"})
    exported(run, tmp_path / "press")
    written = "".join(file.read_bytes().decode("latin-1") for file in (tmp_path / "press").iterdir())
    assert "someone" not in written
    assert str(tmp_path) not in written


@pytest.mark.parametrize(
    "other", [{"fingerprints": {"policy": "0" * 16}}, {"env": {"max_steps": 5}}, {"render": {}}, {"first_seed": 7}]
)
def test_results_of_an_older_policy_or_another_task_are_left_out(
    run: Path, tmp_path: Path, other: dict[str, Any]
) -> None:
    evaluated(run, "simulation", **other)
    evaluated(run, "imagination", success_rate=0.46, ci95=[0.33, 0.6])
    card = exported(run, tmp_path / "press")
    assert "in imagination (open loop) | 46 % | 33 to 60 %" in card
    assert "98 %" not in card


def test_without_results_the_card_says_so(run: Path, tmp_path: Path) -> None:
    assert "Not evaluated yet" in exported(run, tmp_path / "press")


def test_the_commands_of_the_card_are_accepted_and_bring_back_the_config(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # the policy's data set may lie in the folder that the tests are run from
    stored = json.loads((run / "config.json").read_text())
    stored["behaviour"]["steps"] = 77
    stored["collect"]["noise"] = 0.25
    write_json(run / "config.json", stored)
    evaluated(run, "simulation")
    card = exported(run, tmp_path / "press")
    block = card.split("## Make it again")[1].split("```bash\n")[1].split("```")[0]
    lines = [shlex.split(line)[1:] for line in block.splitlines()]
    assert [line[0] for line in lines] == ["collect", "train-policy", "evaluate"]
    recorded, trained = (compose(line[1:], "collect") for line in lines[:2])
    assert (recorded.episodes, recorded.collect.noise, recorded.policy) == (150, 0.25, "expert")
    assert (trained.behaviour.steps, trained.seed, trained.run) == (77, 0, "pretrained")
    assert (trained.preset, trained.env.name) == ("compact", "button_press")


@pytest.mark.parametrize(
    ("changes", "lines", "trained"),
    [
        ({"demos": 10}, ["collect", "train-policy"], {"run": "pretrained", "demos": 10, "seed": 2}),
        ({"shipped_world_model": False}, ["pipeline", "train-policy"], {"run": "runs/world", "demos": None, "seed": 2}),
        ({"shipped_world_model": False, "demos": 10}, ["pipeline", "train-policy"], {"demos": 10, "seed": 2}),
        ({"shipped_world_model": False, "world_model_seed": 2}, ["pipeline"], {"out": "runs/again", "seed": 2}),
    ],
)
def test_the_card_says_how_many_demonstrations_and_which_seeds(
    changes: dict[str, Any],
    lines: list[str],
    trained: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    write_json(Path("runs/world/config.json"), to_dict(compose([])))  # what the first line leaves
    recorded = {"policy": "expert", "episodes": 150, "steps": 20, "seed": 0, "noise": 0.0}
    source = {"seed": 2, "world_model_seed": 0, "demos": 150, "recorded": recorded, "shipped_world_model": True}
    commands = [shlex.split(line)[1:] for line in reproduce(compose([]), source | changes, [])]
    assert [command[0] for command in commands] == lines
    composed = compose(commands[-1][1:], commands[-1][0])
    assert {key: getattr(composed, key) for key in trained} == trained


@pytest.mark.parametrize(
    ("arguments", "message", "code"),
    [
        (["run={run}"], "out: got nothing or the run itself", 1),
        (["run={run}", "out={run}"], "out: got nothing or the run itself", 1),
        (["run={run}", "out={there}"], "there already", 1),
        (["run={run}", "out={there}", "export.repo=me/press"], "there already", 1),
        (["out={new}"], "run: got nothing", 1),
        (["run={none}", "out={new}"], "expected the folder of a run", 2),
        (["run={run}", "out={new}", "method=lapo"], "got a run of method=lapo", 1),
        (["run={run}", "out={new}", "data.camera=a,b"], "data.camera: got a, b", 1),
        (["run={run}", "out={new}", "export.rep=me/press"], "unknown key export.rep", 2),
    ],
)
def test_what_cannot_be_exported_is_refused_in_one_line(
    run: Path, tmp_path: Path, arguments: list[str], message: str, code: int
) -> None:
    (tmp_path / "there").mkdir()
    places = {name: tmp_path / name for name in ("there", "new", "none")} | {"run": run}
    refused("export", *(text.format(**places) for text in arguments), message=message, code=code)
    assert not (tmp_path / "new").exists()
    assert list((tmp_path / "there").iterdir()) == []


def test_a_run_without_a_policy_or_with_damaged_weights_is_refused(run: Path, tmp_path: Path) -> None:
    weights = run / "policy" / "checkpoint" / "weights.safetensors"
    content = weights.read_bytes()
    weights.write_bytes(content[:-1] + bytes([content[-1] ^ 0xFF]))
    refused("export", f"run={run}", f"out={tmp_path / 'new'}", message="got fingerprint")
    shutil.rmtree(run / "policy")
    refused("export", f"run={run}", f"out={tmp_path / 'new'}", message="expected a trained policy")
    assert not (tmp_path / "new").exists()


def test_an_exported_policy_is_played_and_other_commands_say_what_it_is(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    exported(run, tmp_path / "press")
    monkeypatch.chdir(tmp_path)
    for command in ("export", "inspect", "train-policy"):
        refused(command, "run=press", "out=new", message="run=press: got an exported policy, expected the run", code=2)
    config = compose(["run=press", *ONE_CORE], "play")
    before = contents(tmp_path / "press")
    studio = open_studio(config)
    try:
        assert studio.agent is not None
        assert studio.recorded is None
        assert str(studio.out) == "runs/play"
    finally:
        studio.close()
    assert contents(tmp_path / "press") == before


def test_the_same_command_again_says_that_the_policy_is_there(run: Path, tmp_path: Path) -> None:
    """Also after a kill between the last rename and the end, which leaves a whole folder."""
    out = tmp_path / "press"
    exported(run, out)
    before = contents(out)
    again = ("export", f"run={run}", f"out={out}", *ONE_CORE)
    said = f"policy: {out} is there already, exported before"
    assert playslot(*again) == Done(0, f"{said}\n", "")
    assert contents(out) == before
    evaluated(run, "simulation")
    assert playslot(*again) == Done(0, f"{said}; its card is new\n", "")
    assert contents(out).keys() == before.keys()
    assert {name for name in before if contents(out)[name] != before[name]} == {"README.md"}
    assert (out / "README.md").read_text() == exported(run, tmp_path / "anew" / "press")
    (out / "README.md").write_text("of my own")
    assert playslot(*again) == Done(0, f"{said}\n", "")
    assert (out / "README.md").read_text() == "of my own"


def test_a_folder_that_another_export_or_a_damage_left_is_refused(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "press"
    exported(run, out)
    command = ("export", f"run={run}", f"out={out}")
    refused(*command, "data.camera=top", message="has no such camera, expected one of: observation.images.front")
    refused(*command, "data.resize=true", message="got another policy, expected a new folder")
    (out / "policy_postprocessor.json").unlink()
    refused(*command, message="policy_postprocessor.json is missing, expected a whole policy")


def test_another_runs_folder_is_not_pushed_in_its_name(run: Path, tmp_path: Path) -> None:
    exported(run, tmp_path / "press")
    config = tmp_path / "press" / "config.json"
    values = json.loads(config.read_text())
    values["source"]["fingerprints"]["policy"] = "0" * 16
    write_json(config, values)
    out = f"out={tmp_path / 'press'}"
    refused("export", f"run={run}", out, "export.repo=me/press", message="got another policy")
