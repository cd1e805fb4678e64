"""`playslot compare` from end to end; the quick tests run the jobs in this process, the slow ones as it does."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from commands import ONE_CORE, Done, assert_one_line, contents, instead, playslot, refused

from playslot_rl.config.compare import LAUNCHERS
from playslot_rl.config.compose import compose
from playslot_rl.errors import ConfigError
from playslot_rl.storage.atomic import write_json
from playslot_rl.studies.launch import comparison_lock

pytestmark = pytest.mark.integration

Compare = Callable[..., Done]


def _arguments(shared_run: Path, out: Path, *more: object) -> list[str]:
    demos, videos = shared_run / "data" / "expert", shared_run / "data" / "random"
    return ["compare", "preset=smoke", f"run={shared_run}", f"data.demos={demos}", f"data.root={videos}",
            f"out={out}", "episodes=2", *map(str, more), *ONE_CORE]  # fmt: skip


def _result(out: Path) -> dict[str, Any]:
    values: dict[str, Any] = json.loads((out / "comparison.json").read_text())
    return values


@pytest.mark.slow
def test_two_methods_two_numbers_of_demonstrations_one_seed(
    shared_run: Path, tmp_path: Path, started: list[str]
) -> None:
    out = tmp_path / "compared"
    command = _arguments(shared_run, out, "methods=playslot,slot_oracle")
    done = playslot(*command)
    assert (done.code, done.err) == (0, "")
    assert started == ["playslot-d2-s0", "slot_oracle-d2-s0", "playslot-d3-s0", "slot_oracle-d3-s0"]
    result = _result(out)
    assert [(row["method"], row["protocol"], row["demos"]) for row in result["summary"]] == [
        ("playslot", "simulation", 2), ("playslot", "imagination", 2), ("slot_oracle", "simulation", 2),
        ("playslot", "simulation", 3), ("playslot", "imagination", 3), ("slot_oracle", "simulation", 3),
    ]  # fmt: skip
    assert {row["status"] for row in result["rows"]} == {"done"}
    assert [row["labelled_demos"] for row in result["summary"]] == [2, 2, 2, 3, 3, 3]
    seeds = {tuple(json.loads(path.read_text())["seeds"]) for path in (out / "runs").rglob("eval_info.json")}
    assert len(seeds) == 1, "every method and seed meets the same episodes"
    assert min(seeds.pop()) >= 1_000_000_000 + 100 * 1_000_000
    made = {path.suffix[1:] for path in out.glob("comparison.*")}
    assert made == {"json", "md", "png", "svg", "lock"}
    assert "PlaySlot, imagination" in (out / "comparison.md").read_text()

    kept = contents(out / "runs")
    started.clear()
    again = playslot(*command)
    assert again.code == 0
    assert started == []
    assert again.out.count("done before, skipped") == 4
    more = playslot(*command, "demos=2,3,4")
    assert more.code == 0
    assert started == ["playslot-d4-s0", "slot_oracle-d4-s0"]
    assert {name: contents(out / "runs")[name] for name in kept} == kept


def test_a_method_that_crashes_is_a_row_and_the_others_finish(
    shared_run: Path, tmp_path: Path, started: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from playslot_rl.methods.lapo.training import LAPOBehaviour

    def broken(self: LAPOBehaviour, *arguments: object) -> None:
        raise ZeroDivisionError("a bug")

    command = _arguments(shared_run, tmp_path / "out", "methods=lapo,slot_oracle", "demos=2")
    with monkeypatch.context() as patch:
        patch.setattr(LAPOBehaviour, "__init__", broken)
        done = playslot(*command)
    assert done.code == 1
    assert "lapo-d2-s0: error: ZeroDivisionError: a bug" in done.err
    assert "compare: 1 of 2 jobs failed (lapo-d2-s0), the others finished" in done.err
    rows = {row["name"]: row for row in _result(tmp_path / "out")["rows"]}
    assert (rows["lapo-d2-s0"]["status"], rows["slot_oracle-d2-s0"]["status"]) == ("failed", "done")
    assert "ZeroDivisionError" in rows["lapo-d2-s0"]["error"]
    assert "**lapo-d2-s0: failed.** ZeroDivisionError: a bug" in (tmp_path / "out" / "comparison.md").read_text()
    started.clear()
    assert playslot(*command).code == 0, "the same command tries it again"
    assert started == ["lapo-d2-s0"]
    assert {row["status"] for row in _result(tmp_path / "out")["rows"]} == {"done"}


def test_caddy_and_its_oracle_are_compared_on_one_model(shared_run: Path, tmp_path: Path, started: list[str]) -> None:
    out = tmp_path / "out"
    done = playslot(*_arguments(shared_run, out, "methods=CADDY,CADDY Oracle", "demos=3", "labels=1,2"))
    assert (done.code, done.err) == (0, "")
    assert started == ["caddy_policy-d3-l1-s0", "caddy_policy-d3-l2-s0", "caddy_oracle-d3-s0"]
    metas = [json.loads(path.read_text()) for path in (out / "runs").glob("*/caddy_*/checkpoint/meta.json")]
    assert len(metas) == 3
    assert {meta["parents"]["caddy"] for meta in metas} == {_result(out)["latent_models"]["caddy"][0]["fingerprint"]}
    first, second = (out / "runs" / f"caddy_policy-d3-l{n}-s0" / "caddy_policy" for n in (1, 2))
    kept = "checkpoints/step_00000006/state.json"
    assert (second / kept).read_bytes() == (first / kept).read_bytes(), "the policy needs no label: trained once"
    assert [row["labelled_demos"] for row in _result(out)["summary"]] == [1, 2, 3]
    page = (out / "comparison.md").read_text()
    assert "CADDY's video model: " in page
    assert "With the actions of all 3: CADDY Oracle" in page


@pytest.mark.slow
def test_two_world_models_on_a_test_block_drawn_once(shared_run: Path, tmp_path: Path, started: list[str]) -> None:
    out = tmp_path / "out"
    command = _arguments(shared_run, out, "methods=slot_oracle,lapo", "demos=2", "compare.reference=lapo")
    assert playslot(*command).code == 0
    before = _result(out)
    started.clear()
    done = playslot(*command, "worlds=2")
    assert (done.code, done.err) == (0, "")
    assert started == ["slot_oracle-d2-w1-s0", "lapo-d2-w1-s0"], "those of the first world model are done"
    found = _result(out)
    assert found["world_models"][1]["source"] == "world_model_1"
    prints = {world["fingerprints"]["slots"] for world in found["world_models"]}
    prints |= {model["fingerprint"] for model in found["latent_models"]["lapo_model"]}
    assert len(prints) == 4, "two SAVis and two models of LAPO"
    assert [row["runs"] for row in found["summary"]] == [2, 2]
    assert [row["method"] for row in found["differences"]] == ["slot_oracle"]
    other, named = tmp_path / "other", f"baselines.lapo.world={out / 'lapo_world'}"
    taking = _arguments(shared_run, other, "methods=lapo", "demos=2")
    done = playslot(*taking, f"baselines.lapo.world={tmp_path}")
    assert (done.code, "lapo_model" in done.err) == (1, True)
    assert not other.exists(), "nothing was computed"
    assert playslot(*taking, named).code == 0
    assert not (other / "lapo_world").exists()
    assert _result(other)["latent_models"] == {"lapo_model": found["latent_models"]["lapo_model"][:1]}
    assert (before["block"]["kind"], before["summary"][0]["runs"]) == ("development", 1)

    started.clear()
    assert playslot(*command, "worlds=2", "compare.block=test").code == 0
    test = _result(out)["block"]
    assert (test["kind"], len(started)) == ("test", 4), "every policy meets the new episodes"
    assert playslot(*command, "worlds=2", "compare.block=test").out.count("done before, skipped") == 4
    assert _result(out)["block"] == test


CHANGED: dict[str, tuple[str, str]] = {
    "a setting": (
        "behaviour.steps=7",
        "steps: got 7, expected 6, with which slot_oracle-d2-s0 of .* was trained",
    ),
    "a size": (
        "model.policy.mlp_dim=24",
        "model.policy.mlp_dim: got 24, expected .*, with which slot_oracle-d2-s0",
    ),
    "what is held out": ("data.held_out=1", "data.held_out: got 1, expected 0, with which slot_oracle-d2-s0 of"),
    "the world model": (
        "run=pretrained",
        "run: got pretrained/button_press with .*, expected a world model with",
    ),
    "none": ("run=", "run: got .*world_model with none yet, expected a world model with slots .* use another out="),
}


def test_a_changed_setting_is_refused_before_anything_is_written(
    shared_run: Path, tmp_path: Path, started: list[str]
) -> None:
    command = _arguments(shared_run, tmp_path / "out", "methods=slot_oracle", "demos=2")
    assert playslot(*command).code == 0
    before = contents(tmp_path / "out")
    for changed, message in CHANGED.values():
        refused(*command, changed, message=message)
        assert contents(tmp_path / "out") == before
    (file,) = (tmp_path / "out" / "jobs").glob("*-s0.json")  # as a version before left it that tried another setting
    write_json(file, {**(job := json.loads(file.read_text())), "config": {**job["config"], "behaviour": {"steps": 7}}})
    refused(*command, "behaviour.steps=7", message="steps: got 7, expected 6")
    assert playslot(*command).code == 0
    assert len(started) == 1


def test_the_same_command_carries_on_where_it_recorded_the_demonstrations(tmp_path: Path, started: list[str]) -> None:
    command = ["compare", "preset=smoke", "env=button_press", "run=pretrained", "methods=slot_bc", "demos=2",
               "labels=1", "seeds=0", f"out={tmp_path / 'out'}", "episodes=1", *ONE_CORE]  # fmt: skip
    for more, jobs in ((), 1), ((), 1), (("seeds=0,1",), 2):
        assert playslot(*map(str, instead(command, *more))).code == 0
        assert len(started) == jobs


def test_a_comparison_of_one_task_is_not_written_over_that_of_several(shared_run: Path, tmp_path: Path) -> None:
    (tmp_path / "out" / "button_press").mkdir(parents=True)
    for folder in (tmp_path / "out", tmp_path / "out" / "button_press"):
        (folder / "comparison.lock").touch()
    command = _arguments(shared_run, tmp_path / "out", "methods=slot_oracle", "demos=2")
    refused(*command, message="got comparisons of several tasks, by envs=, expected none: choose another")


@pytest.mark.parametrize(
    ("typed", "message"),
    [
        (
            "data.draw=3",
            "data.draw: got 3 with methods=.*, expected seeds=, each of which draws its own",
        ),
        ("model.savi.n_slots=5", "model.savi.n_slots: got 5 with .*, expected none with run=, whose world model is"),
        (
            "slots.clip_frames=3",
            "slots.clip_frames: got 3 with methods=.*, expected none with run=, whose world",
        ),
    ],
)
def test_what_no_job_reads_is_refused(typed: str, message: str, shared_run: Path, tmp_path: Path) -> None:
    for methods in ("slot_oracle", "playslot"):
        command = _arguments(shared_run, tmp_path / "out", f"methods={methods}", "demos=2")
        refused(*command, typed, message=message, code=2)


def test_videos_stand_instead_of_the_presets_demonstrations() -> None:
    typed = ["preset=smoke", "methods=playslot", "labels=2", "videos=3"]
    assert compose(typed, "compare").compare.numbers == (5,)
    with pytest.raises(ConfigError, match="expected none with videos="):
        compose([*typed, "demos=4"], "compare")


def test_what_decides_an_evaluation_is_measured_again_when_it_changes(
    shared_run: Path, tmp_path: Path, started: list[str]
) -> None:
    command = _arguments(shared_run, tmp_path / "out", "methods=slot_oracle", "demos=2")
    assert playslot(*command).code == 0
    first = _result(tmp_path / "out")["rows"][0]
    info = tmp_path / "out" / "runs" / first["name"] / "evaluation" / "simulation" / "eval_info.json"
    weights = (tmp_path / "out" / "runs" / first["name"] / "slot_oracle" / "checkpoint" / "weights.safetensors").stat()
    assert playslot(*command, "env.max_steps=4").code == 0
    assert started == ["slot_oracle-d2-s0"] * 2
    assert json.loads(info.read_text())["max_steps"] == 4
    again = (tmp_path / "out" / "runs" / first["name"] / "slot_oracle" / "checkpoint" / "weights.safetensors").stat()
    assert again.st_mtime_ns == weights.st_mtime_ns, "the training does not depend on it"
    assert playslot("evaluate", f"run={info.parents[2]}", "seed=0", "episodes=1", *ONE_CORE).code == 0
    assert json.loads(info.read_text())["episodes"] == 1
    assert playslot(*command).code == 0
    assert started == ["slot_oracle-d2-s0"] * 3, "what another command wrote there is none of the table"
    assert _result(tmp_path / "out")["rows"][0]["outcomes"] == first["outcomes"]
    assert again == info.parents[2].joinpath("slot_oracle", "checkpoint", "weights.safetensors").stat()


def test_a_method_that_acts_is_trained_and_evaluated(tmp_path: Path, started: list[str]) -> None:
    out = tmp_path / "out"
    done = playslot("compare", "preset=smoke", "env=block_reach", "env.max_steps=6", "methods=dreamer", "seeds=0",
                    f"out={out}", "episodes=2", *ONE_CORE)  # fmt: skip
    assert (done.code, done.err) == (0, "")
    (row,) = _result(out)["rows"]
    assert (row["status"], row["episodes"], row["agent_steps"]) == ("done", 2, 36)
    assert row["env_steps"] == 36 * _result(out)["frame_skip"]
    assert len(row["curve"]) == 3


def test_a_second_command_on_the_same_folder_is_refused(shared_run: Path, tmp_path: Path) -> None:
    with comparison_lock(tmp_path / "out"):
        done = playslot(*_arguments(shared_run, tmp_path / "out", "methods=slot_oracle", "demos=2"))
    assert done.code == 1
    assert_one_line(done.err, "compare")
    assert "that another comparison works on" in done.err


@pytest.mark.parametrize(
    ("typed", "message", "code"),
    [
        ("methods=playslot,magic", "compare.methods: got 'magic', expected one of playslot", 2),
        ("demos=2,9", "demos: got 9, expected at most the 8 demonstrations of data.demos=", 1),
        ("env=grid_shapes", "env=grid_shapes: got an environment without a simulator", 1),
        ("hydra.launcher=ray", "expected an installed launcher", 1),
        ("run=nowhere", "run=nowhere: no such folder", 1),
    ],
)
def test_what_cannot_be_compared_is_refused_before_anything_is_computed(
    shared_run: Path, tmp_path: Path, typed: str, message: str, code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(LAUNCHERS, "ray", "a_module_that_is_not_installed")
    done = playslot(*map(str, instead(_arguments(shared_run, tmp_path / "out", "methods=playslot"), typed)))
    assert done.code == code
    assert_one_line(done.err, "compare")
    assert message in done.err
    assert not (tmp_path / "out").exists()


def test_a_sparse_reward_is_refused_for_a_method_that_acts(tmp_path: Path) -> None:
    done = playslot("compare", "preset=smoke", "env=block_reach", "methods=dreamer", "env.blocks.reward=sparse",
                    f"out={tmp_path / 'out'}")  # fmt: skip
    assert (done.code, list(tmp_path.iterdir())) == (1, [])
    assert "env.blocks.reward: got sparse with method=dreamer, expected dense" in done.err


def test_a_folder_of_something_else_is_refused(shared_run: Path, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    done = playslot(*_arguments(shared_run, tmp_path, "methods=slot_oracle"))
    assert done.code == 1
    assert "holds something else" in done.err
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


@pytest.mark.slow
def test_from_nothing_data_and_world_model_are_made_once(tmp_path: Path, started: list[str]) -> None:
    out = tmp_path / "out"
    command = [
        "compare",
        "preset=smoke",
        "methods=slot_oracle,lapo,CADDY,caddy_oracle",
        "demos=3",
        f"out={out}",
        "episodes=2",
        *ONE_CORE,
    ]
    done = playslot(*command)
    assert (done.code, done.err) == (0, "")
    assert {path.name for path in (out / "data").iterdir() if path.is_dir()} == {"expert", "random"}
    assert (out / "world_model" / "slots" / "checkpoint").is_dir()
    assert not (out / "world_model" / "dynamics").exists()  # none of these builds on it
    assert (out / "lapo_world" / "lapo_model" / "checkpoint").is_dir()
    assert (out / "caddy_world" / "caddy" / "checkpoint").is_dir()
    assert [world["source"] for world in _result(out)["world_models"]] == ["world_model"]
    shared = {name: contents(out / name) for name in ("data", "world_model", "lapo_world", "caddy_world")}
    more = ["demos=3,6" if word == "demos=3" else word for word in command]
    assert playslot(*more).code == 0
    assert {name: contents(out / name) for name in shared} == shared


@pytest.mark.slow
def test_two_tasks_have_a_folder_each_and_a_table_over_both(tmp_path: Path, started: list[str]) -> None:
    out, tasks = tmp_path / "out", ("block_push_easy", "metaworld_drawer-open")
    command = ["compare", "preset=smoke", "envs=block_push_easy,metaworld/drawer-open", "methods=slot_bc,resnet_bc",
               "demos=3", "labels=2", "compare.reference=slot_bc", f"out={out}", "episodes=2", *ONE_CORE]  # fmt: skip
    done = playslot(*command)
    assert (done.code, done.err) == (0, "")
    assert started == ["slot_bc-d2-l2-s0", "resnet_bc-d2-l2-s0"] * 2
    prints = {_result(out / task)["world_models"][0]["fingerprints"]["slots"] for task in tasks}
    assert len(prints) == 2, "a world model each"
    found = _result(out)["across_tasks"]
    assert found["tasks"] == list(tasks)
    for task in tasks:
        own = [row for row in found["summary"] if row["env"] == task]
        assert own == [{"env": task, **row} for row in _result(out / task)["summary"]]
    assert [(row["method"], row["labels"]) for row in found["rows"]] == [("slot_bc", 2), ("resnet_bc", 2)]
    assert "| interquartile mean | " in done.out.rpartition("compare: ")[0]
    assert {path.suffix[1:] for path in out.glob("comparison.*")} == {"json", "md", "png", "svg", "lock"}

    # As after a kill in the middle of the second task: what is done stays, the rest is computed.
    started.clear()
    (out / tasks[1] / "jobs" / "resnet_bc-d2-l2-s0.status.json").unlink()
    (out / "comparison.json").unlink()
    kept = contents(out / tasks[1] / "world_model")
    assert playslot(*command).code == 0
    assert started == ["resnet_bc-d2-l2-s0"]
    assert contents(out / tasks[1] / "world_model") == kept
    assert _result(out)["across_tasks"] == found


def _process(command: list[str]) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "playslot_rl", *command], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    )  # fmt: skip


@pytest.mark.slow
def test_killed_it_carries_on_and_ends_as_one_that_was_not(shared_run: Path, tmp_path: Path) -> None:
    whole, killed = (
        _arguments(shared_run, tmp_path / name, "methods=slot_oracle", "demos=2,3") for name in ("whole", "killed")
    )
    process = _process(whole)
    assert process.communicate(timeout=280)[1] == ""
    assert process.returncode == 0
    process = _process(killed)
    limit = time.monotonic() + 120
    while not list((tmp_path / "killed" / "runs").rglob("eval_info.json")) and time.monotonic() < limit:
        assert process.poll() is None
        time.sleep(0.01)
    process.kill()
    assert process.wait() == -signal.SIGKILL
    assert _process(killed).wait(timeout=280) == 0
    results = [_result(tmp_path / name) for name in ("whole", "killed")]
    assert results[0]["summary"] == results[1]["summary"]
    prints = [
        [
            json.loads(path.read_text())["fingerprint"]
            for path in sorted((tmp_path / n / "runs").rglob("checkpoint/meta.json"))
        ]
        for n in ("whole", "killed")
    ]
    assert prints[0] == prints[1]


@pytest.mark.slow
def test_joblib_runs_the_jobs_side_by_side(shared_run: Path, tmp_path: Path) -> None:
    command = _arguments(shared_run, tmp_path / "out", "methods=slot_oracle", "demos=2,3",
                         "hydra.launcher=joblib", "hydra.launcher.n_jobs=2")  # fmt: skip
    done = playslot(*command)
    assert (done.code, done.err) == (0, ""), (tmp_path / "out" / "jobs" / "launcher.log").read_text()
    assert [row["status"] for row in _result(tmp_path / "out")["rows"]] == ["done", "done"]
    assert "Joblib.Parallel" in (tmp_path / "out" / "jobs" / "launcher.log").read_text()


@pytest.mark.slow
def test_joblib_runs_two_jobs_of_two_processes_each(shared_run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = _arguments(shared_run, out, "methods=slot_oracle", "demos=2,3", "processes=2")
    done = playslot(*command, "hydra.launcher=joblib", "hydra.launcher.n_jobs=2")
    assert (done.code, done.err) == (0, ""), (out / "jobs" / "launcher.log").read_text()
    assert [row["status"] for row in _result(out)["rows"]] == ["done", "done"]
    again = playslot(*(word for word in command if word != "processes=2"))
    assert again.out.count("done before, skipped") == 2, "in one process they are the same jobs"
