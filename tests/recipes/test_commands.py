"""The recipes from end to end: what each command makes, and that commands compose in every promised way."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
from commands import Done, contents, playslot, refused, smoke, weights

from playslot_rl.config import EnvConfig, RenderConfig
from playslot_rl.config.compose import compose
from playslot_rl.data.agreement import say_once
from playslot_rl.envs import make_env, task_metadata
from playslot_rl.evaluation.intervals import wilson
from playslot_rl.recipes.play import simulated_starts
from playslot_rl.runs import Run

pytestmark = pytest.mark.integration

KEYS = {
    "protocol", "episodes", "seeds", "success_rate", "ci95", "mean_steps_to_success", "labelled_demos", "demos",
    "references",
}  # fmt: skip


def test_the_pipeline_makes_a_whole_run(pipeline: tuple[Path, Done]) -> None:
    run, done = pipeline
    for stage in ("slots", "dynamics", "policy"):
        files = {path.name for path in (run / stage / "checkpoint").iterdir()}
        assert files == {"weights.safetensors", "config.json", "meta.json"}
        assert any((run / stage / "logs").rglob("*"))
    assert {path.name for path in (run / "data").iterdir()} == {"random", "expert"}
    assert not [path for path in run.rglob("*") if ".tmp-" in path.name or path.name.endswith(".journal")]
    assert json.loads((run / "config.json").read_text())["preset"] == "smoke"
    assert done.err == ""
    assert str(run / "report.html") in done.out


def test_the_recorded_demonstrations_beyond_those_trained_on_measure(shared_run: Path) -> None:
    meta = json.loads((shared_run / "policy" / "checkpoint" / "meta.json").read_text())
    assert (meta["demos"], meta["held_out_demos"]) == (6, 2)
    names = ("unexplained_parsed", "unexplained_imagined", "oracle_unexplained", "decoder_unexplained")
    names += ("decoder_trial_unexplained", "finetune_unexplained")
    assert meta["metrics"].keys() == {*names, *(f"{name}_held_out" for name in names)}
    assert all(meta["metrics"][name] != meta["metrics"][f"{name}_held_out"] for name in names)
    assert "held-out demonstrations" in (shared_run / "report.md").read_text()


def test_few_labels_are_not_fine_tuned_on(shared_run: Path, demos: Path, tmp_path: Path) -> None:
    tuned = {}
    for labels in (3, 2):  # from three on
        run = tmp_path / str(labels)
        smoke("train-policy", f"run={shared_run}", f"data.demos={demos}", f"out={run}", "behaviour.finetune_labels=3",
              f"behaviour.labelled_demos={labels}", f"behaviour.policy_from={shared_run}")  # fmt: skip
        meta = json.loads((run / "policy" / "checkpoint" / "meta.json").read_text())
        tuned[labels] = "finetune_unexplained" in meta["metrics"]
    assert tuned == {3: True, 2: False}


@pytest.mark.parametrize("protocol", ["simulation", "imagination"])
def test_eval_info_has_the_promised_keys(shared_run: Path, protocol: str) -> None:
    info = json.loads((shared_run / "evaluation" / protocol / "eval_info.json").read_text())
    assert info.keys() >= KEYS
    assert (info["protocol"], info["episodes"], len(info["seeds"])) == (protocol, 2, 2)
    assert 0.0 <= info["success_rate"] <= 1.0
    assert info["ci95"] == list(wilson(round(2 * info["success_rate"]), 2))
    assert (info["demos"], info["labelled_demos"]) == (6, 3)
    assert info["references"].keys() == {"random", "expert", "slot_oracle"}
    for reference in info["references"].values():
        assert 0.0 <= reference["success_rate"] <= 1.0
        assert reference["ci95"] == list(wilson(round(2 * reference["success_rate"]), 2))


def test_an_evaluation_that_sees_otherwise_says_so_there_and_in_the_report(run: Path) -> None:
    done = smoke("evaluate", f"run={run}", "episodes=1", "env.variation.light=0.5")
    assert "note: evaluated with env.camera=, light0.5; " in done.out
    report = (run / "report.md").read_text()
    assert report.count("**seen with env.camera=, light0.5**") == 1, "the imagination's was not"


@pytest.mark.parametrize(
    "command",
    [
        "evaluate protocol=simulation episodes=1 env.max_steps=5",
        "evaluate protocol=slots episodes=1 env.max_steps=5",
        "plan planner=prototypes proposal=none goals=ahead episodes=1 env.max_steps=19 plan.horizon=2 plan.near=0.01",
        "play",
    ],
)
def test_a_policy_of_every_second_frame_acts_at_half_the_rate(
    run: Path, command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    name, *arguments = command.split()
    stored = json.loads((run / "config.json").read_text())
    stored["data"]["stride"] = 2
    (run / "config.json").write_text(json.dumps(stored))
    made: list[EnvConfig] = []

    def make(env: EnvConfig, render: RenderConfig) -> Any:
        made.append(env)
        return make_env(env, render)

    monkeypatch.setattr("playslot_rl.envs.make_env", make)
    monkeypatch.setattr("playslot_rl.evaluation.objects.make_env", make)
    if name == "play":
        starts = simulated_starts(compose([f"run={run}", *arguments], name), Run(run).load_world_model())
        assert starts is not None
        starts.make_task().close()
        assert starts.fps == task_metadata(made[0])["control_hz"] / 10
    else:
        refused(name, f"run={run}", *arguments, "data.stride=1", message="data.stride: got 1, expected 2")
        smoke(name, f"run={run}", *arguments)
    steps = {"plan": 10}.get(name, 3)  # half of them, rounded up
    assert {(env.frame_skip, env.max_steps) for env in made} == {(10, steps)}


def test_evaluation_seeds_are_none_of_the_collected_ones(shared_run: Path) -> None:
    collected = set()
    for name in ("random", "expert"):
        record = json.loads((shared_run / "data" / name / "meta" / "playslot.json").read_text())
        collected |= {episode["seed"] for episode in record["episodes"]}
    assert len(collected) == 6 + 6 + 2  # videos, demonstrations, and those that are held out
    for protocol in ("simulation", "imagination"):
        info = json.loads((shared_run / "evaluation" / protocol / "eval_info.json").read_text())
        assert not collected & set(info["seeds"])


def test_the_report_needs_no_other_file_and_no_network(shared_run: Path) -> None:
    page = (shared_run / "report.html").read_text()
    assert re.findall(r"""(?:src|href|url\()\s*=?\s*["']?((?:https?:)?//[^"')\s]*)""", page) == []
    assert set(re.findall(r"""<img[^>]*src=["']([a-z]+:)""", page)) == {"data:"}
    assert not re.findall(r"""<(?:script|link|iframe)[^>]*(?:src|href)=""", page)
    text = (shared_run / "report.md").read_text()
    figures = re.findall(r"\]\((figures/[^)]+)\)", text)
    assert figures
    assert all((shared_run / figure).is_file() for figure in figures)


def test_a_finished_pipeline_is_skipped_and_left_as_it_was(shared_run: Path, tmp_path: Path) -> None:
    before = contents(shared_run)
    done = playslot("train-slots", "preset=smoke", f"out={shared_run}", f"data.root={shared_run}/data/random")
    assert (done.code, done.err) == (0, "")
    assert done.out == "slots: finished before (6 steps), skipped\n"
    for command, stage in (("train-dynamics", "dynamics"), ("train-policy", "policy")):
        assert f"{stage}: finished before (6 steps), skipped" in smoke(command, f"run={shared_run}").out
    assert contents(shared_run) == before


def test_stages_one_by_one_equal_the_pipeline(shared_run: Path, videos: Path, demos: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    smoke("train-slots", f"out={run}", f"data.root={videos}")
    smoke("train-dynamics", f"run={run}")
    smoke("train-policy", f"run={run}", f"data.root={demos}", "data.held_out=2")
    for stage in ("slots", "dynamics", "policy"):
        assert weights(run, stage) == weights(shared_run, stage)


def test_slots_may_start_from_another_runs(shared_run: Path, videos: Path, tmp_path: Path) -> None:
    arguments = (f"data.root={videos}", f"slots.start_from={shared_run}", "seed=1")
    smoke("train-slots", f"out={tmp_path / 'warm'}", *arguments, "slots.optim.lr=0")
    assert weights(tmp_path / "warm", "slots") == weights(shared_run, "slots")
    meta = json.loads((tmp_path / "warm" / "slots" / "checkpoint" / "meta.json").read_text())
    assert meta["started_from"] == meta["fingerprint"]
    refused(
        "train-slots",
        f"out={tmp_path / 'other'}",
        *arguments,
        "model.savi.slot_dim=48",
        message=r"slots\.start_from=\S+: got \S+ of .* expected .*: give model\.savi",
    )
    assert not (tmp_path / "other").exists()


def test_stages_with_nothing_but_out_equal_the_pipeline(
    shared_run: Path, videos: Path, demos: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    smoke("train-slots", f"out={run}", f"data.root={videos}")
    smoke("train-dynamics", f"out={run}", f"data.root={videos}")
    smoke("train-policy", f"out={run}", f"data.root={demos}", "data.held_out=2")
    assert all(weights(run, stage) == weights(shared_run, stage) for stage in ("slots", "dynamics", "policy"))


def test_a_stage_may_build_on_another_run(shared_run: Path, videos: Path, demos: Path, tmp_path: Path) -> None:
    before = contents(shared_run)
    smoke("train-dynamics", f"run={shared_run}", f"out={tmp_path / 'b'}", f"data.root={videos}", "seed=3")
    assert weights(tmp_path / "b", "slots") == weights(shared_run, "slots")
    assert weights(tmp_path / "b", "dynamics") != weights(shared_run, "dynamics")
    smoke("train-policy", f"run={shared_run}", f"out={tmp_path / 'c'}", f"data.demos={demos}")
    assert weights(tmp_path / "c", "policy") == weights(shared_run, "policy")
    held_out = "data.held_out=2"  # what `run=` had in its config
    smoke("train-policy", f"out={tmp_path / 'c'}", f"data.demos={demos}", held_out)  # its world model is still found
    smoke("evaluate", f"run={tmp_path / 'c'}", "episodes=1", "evaluation.references=false")
    info = json.loads((tmp_path / "c" / "evaluation" / "simulation" / "eval_info.json").read_text())
    assert info["episodes"] == 1
    assert info["references"]["expert"] == {"success_rate": None, "ci95": None}
    assert contents(shared_run) == before


@pytest.mark.parametrize("mode", ["discrete", "continuous", "ground_truth"])
def test_each_latent_mode_trains_to_a_policy(slots_only: Path, demos: Path, mode: str) -> None:
    changes = [f"model.inverse_dynamics.mode={mode}"]
    if mode == "ground_truth":
        changes.append("model.inverse_dynamics.latent_dim=4")
    smoke("train-dynamics", f"run={slots_only}", *changes)
    smoke("train-policy", f"run={slots_only}")
    assert weights(slots_only, "policy")


def test_a_latent_action_a_slot_trains_but_has_no_policy(slots_only: Path, demos: Path) -> None:
    smoke("train-dynamics", f"run={slots_only}", "model.inverse_dynamics.variant=multi")
    before = contents(slots_only)
    refused("train-policy", f"run={slots_only}", message="variant: got multi, expected single: .*train dynamics")
    assert contents(slots_only) == before


def test_a_foreign_data_set_trains_slots_and_dynamics(foreign: Path, tmp_path: Path) -> None:
    run, before = tmp_path / "run", contents(foreign)
    arguments = (f"data.root={foreign}", "data.camera=observation.images.side", "data.validation=0")
    say_once.cache_clear()
    taken = "taken for recordings of env=button_press: if they are a robot's own"
    smoke("train-slots", f"out={run}", *arguments, noted=[taken])
    short = "1 of 3 episodes have fewer frames than the window of 4: they are left out"
    smoke("train-dynamics", f"run={run}", noted=[short])  # the other once
    assert contents(foreign) == before
    refused("train-policy", f"run={run}", message="actions of width 2, expected 4 as in env.action_dim")


def test_videos_without_actions_train_the_unlabelled_stages_only(videos: Path, tmp_path: Path) -> None:
    mute = Path(shutil.copytree(videos, tmp_path / "mute"))
    info = json.loads((mute / "meta" / "info.json").read_text())
    for name in ("action", "seed", "is_last_observation", "next.success"):
        info["features"].pop(name, None)
    (mute / "meta" / "info.json").write_text(json.dumps(info))
    run = tmp_path / "run"
    smoke("train-slots", f"out={run}", f"data.root={mute}")
    smoke("train-dynamics", f"run={run}")
    for oracle in ("true", "false"):  # the decoder needs them, too
        asked = f"behaviour.oracle={oracle}"
        refused("train-policy", f"run={run}", asked, message="got a data set without actions, expected the feature")
    assert not (run / "policy").exists()
