"""What commands refuse, in one table: what is typed, and what one line answers. Nothing is written, nothing changed."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest
from commands import contents, refused, smoke

pytestmark = pytest.mark.integration

MISTYPED = [
    # arguments
    (
        "collect out={new} env=button_pres",
        "unknown env 'button_pres': expected one of .*button_press.*; did you mean env=button_press",
    ),
    ("collect out={new} episods=3", "unknown key episods: .*; did you mean episodes"),
    ("collect out={new} policy=expart", "policy: got 'expart', expected one of random, expert"),
    ("train-slots out={new} data.root={videos} data.cache_limit=lots", r"data\.cache_limit"),
    ("train-slots out={new} data.root={videos} data.workers=-1", r"data\.workers"),
    ("train-slots out={new} data.root={videos} data.shuffle_buffer=0", r"data\.shuffle_buffer"),
    # methods
    (
        "train-baseline method=resnet_bc out={new} data.demos={demos} behaviour.labelled_demos=10",
        "behaviour.labelled_demos: got 10 with method=resnet_bc, which does not read it, expected demos=",
    ),
    (
        "compare methods=resnet_bc,act labels=2 out={new} dynamics.steps=10",
        "dynamics.steps: got 10 with methods=resnet_bc,act, which do not read it, expected baselines.resnet_oracle.st",
    ),
    # plan
    ("plan run={run} planner=icem", r"plan\.planner: got 'icem', expected one of cem, mppi, gradient, prototypes"),
    ("plan run={run} proposal=oracle", r"plan\.proposal: got 'oracle', expected one of none, policy"),
    ("plan run={run} planner=cem,cem", "planner: got .* expected each one once"),
    ("plan run={run} planner=", "planner: got .* expected at least one"),
    ("plan run={run} plan.horizon=0", r"plan\.horizon: got 0, expected at least 1 agent step"),
    ("plan run={run} plan.goals=future", r"plan\.goals: got 'future', expected one of solved, ahead"),
    ("plan run={run} plan.floor=0", r"plan\.floor: got 0\.0, expected a number above 0"),
    ("plan run={run} plan.correlation=1.0", r"plan\.correlation: got 1\.0, expected 0 to under 1"),
    ("plan run={run} plan.elites=5 plan.candidates=4", r"plan\.elites"),
    ("plan run={missing}", "got no .*config.json"),
    # convert, adopt, play
    ("adopt out={new} data.root={videos} minutes=0", "minutes: got 0.0, expected above 0"),
]
"""What no command takes: exit code 2."""

REFUSED = [
    # arguments
    (
        "train-baseline method=dreamer env=block_reach out={new} data.stride=2",
        "data.stride: got 2, expected 1: dreamer",
    ),
    ("collect", "out: got nothing, expected"),
    ("train-slots", "out: got nothing, expected"),
    ("train-dynamics", "(out|run): got nothing, expected"),
    ("train-policy", "(out|run): got nothing, expected"),
    ("evaluate", "run: got nothing, expected"),
    ("train-slots out={new} data.root={videos} device=gpu", "device=gpu"),
    ("train-slots out={new} data.root={videos} device=meta", "device=meta: .*use device=cpu"),
    ("train-slots out={new} data.root={videos} device=cuda:99", "device=cuda:99: .*use device=cpu"),
    ("train-slots out={new} data.root={videos} device=cpu:x", "device=cpu:x: .*use device=cpu"),
    # what a method checks itself
    ("train-baseline method=act out={new} baselines.act.weights=none.pt", "act.weights: got none.pt, expected a file"),
    (
        "train-baseline method=history_bc out={new} baselines.resnet_oracle.weights=none.pt",
        r"baselines\.resnet_oracle\.weights: got none\.pt, expected a file",
    ),
    (
        "train-baseline method=lapo out={new} baselines.lapo.forward_channels=[4,4,4,4,4,4,4]",
        r"baselines\.lapo\.forward_channels: got 7 widths, each of which halves frames of env\.image_size=64",
    ),
    ("train-baseline method=svg out={new} env.image_size=32", "env.image_size: got 32, expected 64.*method svg"),
    ("train-baseline method=caddy_policy out={new} baselines.caddy.perceptual=none.pth", "perceptual.*none.pth"),
    (
        "train-baseline method=sold run={run} out={new} baselines.sold.sequence=99 baselines.sold.context=30",
        r"baselines\.sold\.context: got 30, expected at most",
    ),
    # data sets
    ("train-slots out={new} data.root={missing}", "no such folder, expected a LeRobot data set"),
    ("train-dynamics run={slots} data.root={foreign}", "got no meta/info.json, expected a LeRobot v3.0 data set"),
    ("train-policy run={world} data.demos={old}", "got LeRobot format v2.1, expected v3.0"),
    ("train-slots out={new} data.root={truncated}", "got a parquet file without a footer, expected a whole one"),
    (
        "train-policy run={world} data.demos={unfinalised}",
        "got no rows under data/ and meta/episodes/, expected parquet files; it was never finalised",
    ),
    (
        "train-slots out={new} data.root={cameras}",
        r"got 2 cameras \(observation.images.top, observation.images.side\), expected one: set data.c",
    ),
    (
        "train-slots out={new} data.root={cameras} data.camera=wrist",
        "data.camera=wrist: .* has no such camera, expected one of: observation.images.top, observation.images.side",
    ),
    (
        "train-slots out={new} data.root={videos} env.image_size=32",
        "got frames of 64x64 from .*, expected 32x32: set env.image_size",
    ),
    ("train-dynamics run={run} env.image_size=32", "env.image_size: got 32, expected 64"),
    ("train-policy run={run} env.image_size=32", "env.image_size: got 32, expected 64"),
    ("evaluate run={run} env.image_size=32", "env.image_size: got 32, expected 64"),
    (
        "train-slots out={new} data.root={videos} slots.clip_frames=8",
        "got episodes of at most 7 frames .*, expected at least one of 8",
    ),
    (
        "train-policy run={world} behaviour.labelled_demos=7",
        "behaviour.labelled_demos: got 7, expected at most the 6 demonstrations",
    ),
    ("train-policy run={world} data.demos={demos}:2,{videos}:1", "got weights, expected none"),
    ("train-slots out={new} data.root={videos}:0,{demos}", "expected a number above 0"),
    # checkpoints
    ("train-dynamics run={others}", "was trained on slots [0-9a-f]{16}, got slots [0-9a-f]{16} at "),
    ("train-policy run={others}", "was trained on slots [0-9a-f]{16}, got slots [0-9a-f]{16} at "),
    ("evaluate run={others}", "was trained on slots [0-9a-f]{16}, got slots [0-9a-f]{16} at "),
    ("train-dynamics run={run} out={parted}", "has slots [0-9a-f]{16} of its own, got slots .*: leave run= out "),
    ("train-policy run={run} out={parted}", "has slots [0-9a-f]{16} of its own, got slots .*or use another out="),
    (
        "train-slots out={run} data.root={videos} model.savi.slot_dim=64",
        "model.savi.slot_dim: got 64, expected 32, with which|model.savi.slot_dim: got 64, expected 32 as ",
    ),
    ("train-slots out={run} data.root={videos} slots.steps=9", "slots.steps: got 9, expected 6"),
    ("train-slots out={run} data.root={videos} seed=1", "seed: got 1, expected 0"),
    (
        "train-slots out={run} data.root={videos} data.validation=0.5",
        r"data.validation: got 0.5, expected \S+ as .* was",
    ),
    ("train-dynamics run={run} model.predictor.dim=64", "model.predictor.dim: got 64, expected 32"),
    ("train-dynamics run={run} dynamics.optim.lr=1", "dynamics.optim.lr: got 1.0, expected 0.001"),
    ("train-policy run={run} behaviour.labelled_demos=2", "behaviour.labelled_demos: got 2, expected 3"),
    ("train-policy run={run} model.policy.dim=64", "model.policy.dim: got 64, expected 32"),
    ("train-slots out={run} data.root={demos}", "data: got [0-9a-f]{16}, expected [0-9a-f]{16}"),
    ("train-dynamics run={run} data.root={demos}", "data: got [0-9a-f]{16}, expected"),
    ("train-policy run={run} data.demos={videos}", "data: got [0-9a-f]{16}, expected"),
    ("train-slots out={begun} data.root={videos} seed=1", "seed: got .*, with which .* begun"),
    ("train-slots out={begun} data.root={videos} data.validation=0.5", "data.validation: got .*with which .* begun"),
    ("train-slots out={begun} data.root={videos} slots.steps=8", "slots.steps: got .*, with which .* begun"),
    ("train-policy run={slots}", "no dynamics checkpoint at .*: run `playslot train-dynamics`"),
    ("evaluate run={slots}", "got no policy/checkpoint, expected a trained policy"),
    ("train-dynamics out={new}", "no such folder, expected a run folder"),
    # output folders
    ("collect out={notes}", "something else"),
    ("train-slots out={notes} data.root={demos}", "something else"),
    ("train-dynamics out={notes} data.root={demos}", "something else"),
    ("train-policy out={notes} data.root={demos}", "something else"),
    ("pipeline out={notes}", "something else"),
    ("demo out={notes}", "something else"),
    ("train-slots out={tool} data.root={demos}", "something else"),
    ("train-slots out={cameras} data.root={demos}", "something else"),
    ("train-slots out={file} data.root={demos}", "got a file, expected a folder"),
    # tasks that do not move by actions
    ("demo env=grid_shapes out={new}", "env=grid_shapes: got an environment without a sim"),
    ("pipeline env=sketchy out={new}", "env=sketchy: got an environment without a sim"),
    ("collect env=grid_shapes policy=expert out={new}", "policy: got expert .*move by themselves"),
    ("collect env=grid_shapes env.grid.objects=5 out={new}", "expected 10, .*model.savi.n_slots=6"),
    # plan
    ("plan run={run} plan.every=30", r"plan\.every: got 30, expected at most plan\.horizon"),
    ("plan run={world} proposal=none", "got no policy/checkpoint, expected a trained policy"),
    ("plan run={world} proposal=policy", "got no policy/checkpoint, expected a trained policy"),
    ("plan run={clips}", "env=grid_shapes: got an environment without a simulator, expected one of"),
    ("plan", "run: got nothing, expected"),
    ("plan run=pretrained/grid_shapes out={new}", "no pretrained world model for env=grid_shapes"),
    ("plan run=pretrained", "out: got nothing with run=pretrained"),
    # inspect, evaluate
    ("inspect", "run: got nothing, expected"),
    ("inspect run={slots} data.root={videos}", "no dynamics checkpoint"),
    ("inspect run={slots} data.root={videos} out={new}", "inspect writes into run="),
    ("inspect run=pretrained data.root= out={new}", "inspect: got no data set"),
    ("inspect run=pretrained data.root={videos}", "out: got nothing, expected"),
    ("inspect run=pretrained data.root={videos} out={videos}", "got a place inside the data set"),
    (
        "evaluate run=pretrained/block_push env=button_press out={new}",
        "env: got button_press, expected block_push, with which run=pretrained",
    ),
    # convert, adopt, play
    ("convert data.root={videos} out={new}", "env: got button_press, expected sketchy"),
    ("convert env=sketchy out={new}", "data.root: got nothing"),
    ("convert env=sketchy data.root={videos}", "out: got nothing"),
    ("adopt out={new}", r"data\.root: got nothing"),
    ("adopt data.root={videos}", "out: got nothing"),
    ("adopt out={new} data.root={videos},{demos}", r"data\.root: got .*, expected one data set"),
    ("adopt out={new} data.root={videos}:2,{demos}", "expected one data set"),
    ("adopt out={new} data.root={cameras}", r"got 2 cameras .* set data\.camera="),
    ("adopt out={new} data.root={missing}", "no such folder, expected a LeRobot data set"),
    ("adopt out={new} data.root={videos} env=button_press", "env: got button_press, expected video"),
    ("play run=pretrained data.root={cameras}", r"got 2 cameras .* set data\.camera="),
    ("play run=pretrained data.root={missing}", "no such folder|got no data set"),
]
"""What does not fit what is there: exit code 1."""


def _damaged(set_: Path, fault: str) -> None:
    if fault == "foreign":
        shutil.rmtree(set_ / "meta")
    elif fault == "old":
        info = set_ / "meta" / "info.json"
        info.write_text(info.read_text().replace('"v3.0"', '"v2.1"'))
    elif fault == "truncated":
        data = next((set_ / "data").rglob("*.parquet"))
        data.write_bytes(data.read_bytes()[: data.stat().st_size // 2])
    else:
        shutil.rmtree(set_ / "meta" / "episodes")


@pytest.fixture(scope="module")
def places(
    shared_run: Path, videos: Path, demos: Path, foreign: Path, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Path]:
    """What the table names: runs at every stage, data sets that are whole and that are not, folders of others."""
    root = tmp_path_factory.mktemp("places")
    found = {"run": shared_run, "videos": videos, "demos": demos, "cameras": foreign}
    found |= {name: root / name for name in ("new", "missing", "notes", "tool", "file")}
    for name, left_out in {
        "world": ("policy",),
        "slots": ("policy", "dynamics"),
        "begun": ("checkpoint",),
        "clips": (),
        "others": ("slots",),
        "parted": ("policy", "dynamics", "slots"),
    }.items():
        ignored = shutil.ignore_patterns("figures", "logs", "data", "evaluation", *left_out)
        found[name] = Path(shutil.copytree(shared_run, root / name, ignore=ignored))
    smoke("train-slots", f"out={root / 'other'}", f"data.root={videos}", "seed=1")
    for name in ("others", "parted"):
        shutil.copytree(root / "other" / "slots", found[name] / "slots")
    config = json.loads((found["clips"] / "config.json").read_text())
    config["env"]["name"] = "grid_shapes"
    (found["clips"] / "config.json").write_text(json.dumps(config))
    for name in ("foreign", "old", "truncated", "unfinalised"):
        found[name] = Path(shutil.copytree(videos, root / name))
        _damaged(found[name], name)
    for name, file in (("notes", "notes.txt"), ("tool", "config.json")):
        found[name].mkdir()
        (found[name] / file).write_text("{}")
    found["file"].write_text("mine")
    return found


@pytest.mark.parametrize(("typed", "message"), [*MISTYPED, *REFUSED], ids=[row[0] for row in (*MISTYPED, *REFUSED)])
def test_it_is_refused_in_one_line(places: dict[str, Path], typed: str, message: str) -> None:
    named = set(re.findall(r"\{(\w+)\}", typed))
    before = {name: contents(places[name]) for name in named}
    refused(*typed.format_map(places).split(), message=message, code=2 if (typed, message) in MISTYPED else 1)
    assert {name: contents(places[name]) for name in named} == before
    assert not places["new"].exists()
