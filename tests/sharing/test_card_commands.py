"""What a card says can be done: its commands are accepted for every kind of run, and run (the long ones when slow tests
do); the policy comes out again, weight for weight.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import playslot, smoke
from recordings import FPS, trained, write_recordings

from playslot_rl.config import to_dict
from playslot_rl.config.compose import choices, compose, compose_each
from playslot_rl.config.plain import flatten
from playslot_rl.envs import ENVIRONMENTS, PROCEDURAL, RECORDED, gym_id
from playslot_rl.sharing.commands import GROUPS, reproduce
from playslot_rl.sharing.folder import read_config
from playslot_rl.storage.atomic import write_json

SAME = ("device=cpu", "threads=1", "workers=1")
"""Of this machine; no card names them."""


def blocks(card: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", card, re.DOTALL | re.MULTILINE)


def lines(card: str) -> list[list[str]]:
    """The card's commands, split as a shell does."""
    return [shlex.split(line) for block in blocks(card, "bash") for line in block.splitlines()]


def exported(run: Path, out: Path, *settings: str) -> str:
    smoke("export", f"run={run}", f"out={out}", *settings)
    return (out / "README.md").read_text()


def run_lines(card: str, folder: Path) -> list[str]:
    """Run every command of a card in the present folder; their names."""
    names = []
    for program, *arguments in lines(card):
        names.append(program if program != "playslot" else arguments[0])
        if program == "playslot":
            done = playslot(*arguments, *SAME)
            assert done.code == 0, (arguments, done.err)
            continue
        given = [argument.replace("THIS_FOLDER", str(folder)) for argument in arguments]
        given = ["--eval.n_episodes=1" if argument.startswith("--eval.n_") else argument for argument in given]
        environment = {**os.environ, "HF_HUB_OFFLINE": "1"}
        command = [str(Path(sys.executable).with_name(program)), *given, "--policy.device=cpu", "--output_dir=eval"]
        done_there = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        assert done_there.returncode == 0, done_there.stderr[-2000:]
    return names


def run_python(card: str, folder: Path, size: tuple[int, int]) -> list[Any]:
    """Run the Python blocks on a frame; the actions they end with."""
    frame = np.random.default_rng(0).integers(0, 256, (*size, 3), dtype=np.uint8)
    actions = []
    for block in blocks(card, "python"):
        import torch

        names: dict[str, Any] = {"frame": frame, "picture": torch.from_numpy(frame).movedim(-1, 0).float() / 255}
        exec(block.replace("THIS_FOLDER", str(folder)), names)
        actions.append(np.asarray(names["action"]).reshape(-1))
    return actions


def policy_print(run: Path) -> str:
    fingerprint: str = json.loads((run / "policy" / "checkpoint" / "meta.json").read_text())["fingerprint"]
    return fingerprint


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recordings(tmp_path_factory.mktemp("robot") / "set")


@pytest.fixture(scope="module")
def strided(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on every third frame, resized."""
    typed = ("data.stride=3", "data.stride_action=last", "data.validation=0.2")
    return trained(tmp_path_factory.mktemp("run") / "run", recordings, *typed)


@pytest.mark.integration
def test_the_card_of_a_run_on_recordings_can_be_followed(
    strided: Path, recordings: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    card = exported(strided, tmp_path / "policy")
    monkeypatch.chdir(tmp_path)
    for name in ("videos", "demonstrations"):
        (tmp_path / "data").mkdir(exist_ok=True)
        shutil.copytree(recordings, tmp_path / "data" / name)
    assert run_lines(card, tmp_path / "policy") == ["train-slots", "train-dynamics", "train-policy"]
    assert policy_print(Path("runs/again")) == policy_print(strided)
    actions = run_python(card, tmp_path / "policy", (80, 96))
    assert len(actions) == 2
    np.testing.assert_array_equal(actions[0], actions[1])
    for wrong in ("--env.task", "playslot pipeline", str(tmp_path), "lerobot-eval --"):
        assert wrong not in card


@pytest.mark.integration
def test_a_policy_of_every_third_frame_says_at_which_rate_it_acts(strided: Path, tmp_path: Path) -> None:
    card = exported(strided, tmp_path / "policy")
    assert "| frames | 10 a second: one frame in 3 of 30, and each action is held until the next |" in card
    assert "uint8 (H, W, 3); 10 a second: one frame in 3 of 30" in card
    assert "`lerobot-rollout` needs `--fps=10`" in card
    assert "| task | push |" in card
    assert "agent steps" not in card  # recordings have no end of an episode
    config = read_config(tmp_path / "policy")
    assert (config.stride, config.fps, config.resize) == (3, FPS / 3, True)
    import playslot_rl

    playslot_rl.load(strided, device="cpu").save_pretrained(tmp_path / "saved")
    again = read_config(tmp_path / "saved")
    assert (again.stride, again.fps, again.resize, again.camera) == (3, FPS / 3, True, "observation.images.top")
    assert "one frame in 3 of 30" in (tmp_path / "saved" / "README.md").read_text()


@pytest.mark.integration
def test_frames_of_another_size_are_resized_as_those_of_the_training_to_the_last_digit(
    strided: Path, recordings: Path, tmp_path: Path
) -> None:
    import torch
    from lerobot.policies import make_pre_post_processors

    import playslot_rl
    from lerobot_policy_playslot.modeling_playslot import PlaySlotPolicy
    from playslot_rl.data.source import open_sources
    from playslot_rl.data.weighted import open_configured

    small = open_configured(compose([f"run={strided}"], "play"), str(recordings))
    large = open_sources(recordings)
    rows = np.arange(0, LAST := int(large.lengths[0]), 3)
    assert LAST == 12
    whole, seen = np.stack([large.frames[row] for row in rows]), small.frames[small.episode_rows(0)]
    assert whole.shape[1:] == (80, 96, 3)
    assert seen.shape[1:] == (64, 64, 3)
    exported(strided, tmp_path / "policy")
    models = [playslot_rl.load(strided, "cpu"), playslot_rl.PlaySlot.from_pretrained(tmp_path / "policy", "cpu")]
    shared = PlaySlotPolicy.from_pretrained(tmp_path / "policy")
    before, after = make_pre_post_processors(shared.config, str(tmp_path / "policy"))
    for model in models:
        slots = model.parse(seen)
        assert torch.equal(model.parse(whole), slots)
        assert torch.equal(model.parse(whole.transpose(0, 3, 1, 2)), slots)
        assert torch.equal(model.parse(whole[None] / np.float32(255))[0], slots)
        codes = torch.tensor([0, 1])
        assert torch.equal(model.imagine(whole[0], codes), model.imagine(seen[0], codes))
        model.reset()
        expected = [model.act(frame) for frame in seen]
        model.reset()
        np.testing.assert_array_equal([model.act(frame) for frame in whole], expected)
        shared.reset()
        pictures = torch.from_numpy(whole).movedim(-1, 1).float() / 255
        key = "observation.images.top"
        acted = [after(shared.select_action(before({key: picture})))[0].numpy() for picture in pictures]
        np.testing.assert_array_equal(acted, expected)
    for shape in ((80, 96), (3, 80), (80, 96, 4), (0, 96, 3)):
        with pytest.raises(ValueError, match=r"frames: got shape .*, expected \(\.\.\., 64, 64, 3\)"):
            models[0].parse(np.zeros(shape, np.uint8))


def test_where_the_training_did_not_resize_other_sizes_are_refused_in_one_line() -> None:
    import playslot_rl

    model = playslot_rl.load("pretrained", "cpu")
    for refuse in (model.parse, model.act, lambda frame: model.imagine(frame, np.array([0, 1]))):
        with pytest.raises(ValueError, match=r"frames: got shape \(80, 96, 3\), expected \(\.\.\., 64, 64, 3\)") as got:
            refuse(np.zeros((80, 96, 3), np.uint8))
        assert "\n" not in str(got.value)


def policy_of(*arguments: str, **source: Any) -> tuple[tuple[str, ...], dict[str, Any]]:
    known = {"seed": 0, "world_model_seed": 0, "demos": 6, "shipped_world_model": False}
    return ("preset=smoke", *arguments), known | source


KINDS: dict[str, tuple[tuple[str, ...], dict[str, Any]]] = {
    **{f"pipeline of {env}": policy_of(f"env={env}") for env in ENVIRONMENTS if env != "gym"},
    "pipeline of a Gymnasium environment": policy_of("env=gym", "env.id=FetchReach-v4", "env.camera=1,90,-20,1,1,0"),
    "another view": policy_of("env=metaworld", "env.task=drawer-open", "env.camera=corner2"),
    "a view of before": policy_of("env=metaworld", "env.task=reach+push", "env.camera="),
    "shipped world model": policy_of(shipped_world_model=True, recorded={"episodes": 6, "seed": 7}, seed=7),
    "shorter evaluation": policy_of("env.max_steps=4", shipped_world_model=True, recorded={"episodes": 6, "seed": 7}),
    "demonstrations of a robot": policy_of(shipped_world_model=True, recorded_elsewhere=True, world_model_seed=3),
    "resized": policy_of("data.resize=true", "env.image_size=32", "model.savi.encoder_strides=[2,2,1]"),
    "strided": policy_of("data.stride=3", "env.max_steps=7"),
    "a simulator's task, recorded elsewhere": policy_of(
        "data.root=/home/me/a,/home/me/b", "data.demos=/home/me/b", "data.camera=observation.images.top",
        "data.held_out=2", recorded_elsewhere=True,
    ),
    "two cameras": policy_of("env=video", "data.camera=observation.images.top,observation.images.side"),
    "weights": policy_of("env=video", "data.root=/home/me/a:2,/home/me/b:1", "slots.start_from=/home/me/savi"),
    "patience": policy_of("env=video", "slots.patience=2", "slots.validate_every=7", "dynamics.patience=1"),
    "another seed, fewer demonstrations": policy_of("env=video", "demos=3", world_model_seed=4),
    "sketchy": policy_of("env=sketchy", "data.root=/home/me/a"),
}  # fmt: skip


@pytest.mark.integration
@pytest.mark.parametrize("kind", KINDS)
def test_the_commands_are_accepted_and_bring_back_the_config(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    typed, source = KINDS[kind]
    config = compose(typed)
    monkeypatch.chdir(tmp_path)
    last: Any = None
    commands = [shlex.split(line)[1:] for line in reproduce(config, source, [])]
    for command, *arguments in commands:
        last = compose_each(arguments, command)[0]
        if command == "pipeline":
            gym_id(last.env.name)
        elif command == "collect":
            assert last.collect.expert_steps == config.collect.expert_steps, "however long episodes of evaluation are"
        else:
            assert last.data.demos or last.data.root
        write_json(Path(last.out) / "config.json", to_dict(last))  # what the command leaves
    assert (commands[-1][0], last.out) in (("pipeline", "runs/again"), ("train-policy", "runs/again"))
    assert last.seed == source["seed"]
    assert last.demos == config.demos
    assert last.env.camera == config.env.camera
    own, got = flatten(to_dict(config)), flatten(to_dict(last))
    free = ("every", "data.root", "data.demos", "start_from", "segmented_episodes")
    for key, value in own.items():
        if key.startswith(tuple(f"{group}." for group in GROUPS)) and not key.endswith(free):
            shipped = source["shipped_world_model"] and key.startswith(("model.", "slots.", "dynamics."))
            assert shipped or got[key] == value, key
    assert last.slots.validate_every == config.slots.validate_every or not config.slots.patience
    assert "/home/me" not in str(commands)


D, V = "data/demonstrations", "data/videos"
ONE = (f"data.root={D} data.demos={D}", f"data.demos={D}")
BOTH = (f"data.root={D}_1,{D}_2 data.demos={D}_1,{D}_2", f"data.demos={D}_1,{D}_2")
SOME = (f"data.root={V}_1,{D} data.demos={D}", f"data.demos={D}")
HELD: dict[str, tuple[str, str, tuple[str, str]]] = {
    "one set, named twice": ("/h/a", "/h/a", ONE),
    "one set, named once": ("/h/a", "", ONE),
    "one set, written in two ways": ("/h/a", "/h/b/../a/", ONE),
    "several sets": ("/h/a,/h/b", "/h/a,/h/b", BOTH),
    "several sets, named once": ("/h/a,/h/b", "", BOTH),
    "demonstrations among the videos": ("/h/a,/h/b", "/h/b/", SOME),
    "demonstrations beside the videos": ("/h/a", "/h/b", (f"data.root={V}", f"data.demos={D}")),
}


@pytest.mark.parametrize("kind", HELD)
def test_demonstrations_that_are_held_out_are_held_out_of_the_videos_too(kind: str) -> None:
    root, demos, (videos, taught) = HELD[kind]
    typed = ["preset=smoke", "env=video", f"data.root={root}", f"data.demos={demos}"]
    config, world = compose([*typed, "data.held_out=2"]), compose([*typed, "data.held_out=3"])
    for other, kept in ((None, "data.held_out=2"), (world, "data.held_out=3")):
        slots, _, policy = ({*line.split()} for line in reproduce(config, {"seed": 3}, [], other))
        assert {*videos.split()} <= slots
        assert {"data.held_out=2", taught} <= policy
        assert {word for word in slots if word.startswith("data.held_out=")} == (
            {kept} if "data.demos" in videos else set()
        )


def test_the_pipeline_of_one_set_names_it_once() -> None:
    typed = ["preset=smoke", "env=button_press", "data.root=/h/a", "data.demos=/h/a/", "data.held_out=2"]
    (line,) = reproduce(compose(typed), {"seed": 3, "recorded_elsewhere": True}, [])
    assert {f"data.root={D}", f"data.demos={D}", "data.held_out=2"} <= {*line.split()}


def test_what_the_world_models_run_held_out_of_other_demonstrations_is_named() -> None:
    config = compose(["preset=smoke", "env=video", "data.root=/h/a", "data.demos=/h/c", "data.held_out=2"])
    world = compose(["preset=smoke", "env=video", "data.root=/h/a,/h/b", "data.demos=/h/b", "data.held_out=3"])
    slots, _, policy = (line.split() for line in reproduce(config, {"seed": 3}, [], world))
    assert {f"data.root={V}_1,{D}_2", f"data.demos={D}_2", "data.held_out=3"} <= {*slots}
    assert {f"data.demos={D}_1", "data.held_out=2"} <= {*policy}


@pytest.mark.parametrize(
    ("typed", "commands"),
    [
        (["env=block_push_easy", "env.variation.object=true"], ["pipeline", "train-policy"]),
        (["env=video", "data.demos=/home/me/b"], ["train-slots", "train-dynamics", "train-policy"]),
    ],
)
def test_the_world_model_of_another_run_is_made_by_that_runs_settings(typed: list[str], commands: list[str]) -> None:
    given = "behaviour.policy_from=/home/me/copied"
    config = compose(["preset=smoke", *typed, "data.root=/home/me/b", "behaviour.labelled_demos=2", given])
    own = ["model.inverse_dynamics.slots=[1,2]", "slots.steps=7", "data.stride=2", "data.root=/home/me/a,/home/me/b"]
    world, source = compose(["preset=smoke", *typed, *own]), policy_of()[1]
    made = [shlex.split(line)[1:] for line in reproduce(config, source, [], world)]
    assert [command for command, *_ in made] == commands
    first, last = made[0], made[-1]
    assert {*own[:3], "out=runs/world"} <= {*first}
    assert not {*own[:3]} & {*last}
    assert {"run=runs/world", "out=runs/again", "behaviour.labelled_demos=2"} <= {*last} | {*first}
    assert "behaviour.labelled_demos=2" not in first
    assert ("data.root=data/videos_1,data/demonstrations" in first) == (commands[0] == "train-slots")
    assert "/home/me" not in str(made)
    assert "policy_from" not in str(made)


def test_every_environment_with_a_preset_is_of_some_kind() -> None:
    assert {compose(typed).env.name for typed, _ in KINDS.values()} == {*choices("env")} - {*PROCEDURAL}
    assert {*RECORDED, *ENVIRONMENTS, *PROCEDURAL} == {*choices("env")}


def test_the_use_of_a_simulators_policy_names_what_differs_from_the_task(tmp_path: Path) -> None:
    from dataclasses import replace

    from lerobot_policy_playslot import PlaySlotEnv
    from playslot_rl.sharing.commands import use
    from playslot_rl.sharing.folder import SharedPolicyConfig

    config = compose(["preset=paper", "env=block_push", "render.quality=full"])
    env = replace(config.env, image_size=32, max_steps=25)
    policy = SharedPolicyConfig(env=env, stride=3, fps=3.3, camera="observation.images.top")
    (command,) = lines(use(policy, config))
    options = dict(part.removeprefix("--").split("=", 1) for part in command[1:])
    made = PlaySlotEnv(
        task=options["env.task"],
        image_size=int(options["env.image_size"]),
        frame_skip=int(options["env.frame_skip"]),
        episode_length=int(options["env.episode_length"]),
        quality=options["env.quality"],
    )
    assert made.task_config() == replace(env, frame_skip=3 * env.frame_skip, max_steps=9)
    assert json.loads(options["rename_map"]) == {"observation.images.front": "observation.images.top"}
    for changed in ("env.variation.shake=0.5", "env.blocks.distractors=1", "env.warmup_steps=1"):
        said = use(SharedPolicyConfig(env=compose(["env=block_push", changed]).env))
        assert "lerobot-eval --" not in said, "it would run another task"
        assert said.startswith("`lerobot-eval` has no options for what was changed of this task")
    plain = SharedPolicyConfig(env=compose(["env=block_push"]).env)
    assert not [part for part in lines(use(plain))[0] if part.startswith(("--env.i", "--env.f", "--env.e", "--env.q"))]


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(
    "env", sorted(env for env in ENVIRONMENTS if env not in ("gym", "ogbench") and not env.startswith("dmc_"))
)
def test_the_card_of_a_pipelines_run_can_be_followed(env: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    smoke("pipeline", f"env={env}", "out=runs/first", "seed=3")
    card = exported(Path("runs/first"), tmp_path / "policy")
    names = run_lines(card, tmp_path / "policy")
    assert names == ["lerobot-eval", "pipeline", "evaluate", "evaluate"]
    assert policy_print(Path("runs/again")) == policy_print(Path("runs/first"))
    assert len(run_python(card, tmp_path / "policy", (64, 64))) == 1


def adopted(tmp: Path) -> tuple[Path, Path, tuple[str, ...]]:
    data = write_recordings(tmp / "robot", ("top", "side"))
    quick = ("minutes=0.02", "adopt.slots=[2]", "adopt.prototypes=4", "data.camera=side")
    smoke("adopt", f"data.root={data}", *quick, "out=runs/mine")
    smoke("train-policy", "run=runs/mine", "behaviour.labelled_demos=2", "seed=5", "out=runs/first")
    return Path("runs/first"), data, ()


def of_two_cameras(tmp: Path) -> tuple[Path, Path, tuple[str, ...]]:
    data = write_recordings(tmp / "robot", ("top", "side"))
    return trained(tmp / "runs" / "first", data, "data.camera=top,side"), data, ("data.camera=side",)


def on_the_shipped(tmp: Path) -> tuple[Path, Path, tuple[str, ...]]:
    smoke("demo", "out=runs/first", "episodes=1", "evaluation.references=false")
    return Path("runs/first"), Path("runs/first/data/expert"), ()


def on_anothers_world(tmp: Path) -> tuple[Path, Path, tuple[str, ...]]:
    smoke("pipeline", "env=block_push_easy", "out=runs/other", "seed=3", "slots.steps=5")
    demos = "data.demos=runs/other/data/expert"
    smoke("train-policy", "run=runs/other", demos, "behaviour.labelled_demos=1", "seed=3", "out=runs/first")
    return Path("runs/first"), Path("runs/other/data/expert"), ()


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(
    ("made", "names"),
    [
        (adopted, ["train-slots", "train-dynamics", "train-policy"]),
        (of_two_cameras, ["train-slots", "train-dynamics", "train-policy"]),
        (on_the_shipped, ["lerobot-eval", "collect", "train-policy", "evaluate", "evaluate"]),
        (on_anothers_world, ["lerobot-eval", "pipeline", "train-policy"]),
    ],
)
def test_the_card_of_another_kind_of_run_can_be_followed(
    made: Callable[[Path], tuple[Path, Path, tuple[str, ...]]],
    names: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    run, data, chosen = made(tmp_path)
    card = exported(run, tmp_path / "policy", *chosen)
    if not {"collect", "pipeline"} & {*names}:
        for name in ("videos", "demonstrations"):
            shutil.copytree(data, tmp_path / "data" / name)
    if made in (adopted, of_two_cameras):
        assert read_config(tmp_path / "policy").camera == "observation.images.side"
    assert run_lines(card, tmp_path / "policy") == names
    if "followed the clock" not in card:  # which the card says where a slow machine has changed the planned steps
        assert policy_print(Path("runs/again")) == policy_print(run)
    assert run_python(card, tmp_path / "policy", (64, 64))
