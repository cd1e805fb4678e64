"""`playslot adopt`: any LeRobot set with a camera becomes a world model; choices are made once and said."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from commands import refused, smoke

from playslot_rl.config.compose import compose
from playslot_rl.data.windows import split_episodes
from playslot_rl.datasets import adoption
from playslot_rl.datasets.adoption import SHORTEST, clip_room, savi_for, scheduled, start_for, steps_within, too_short
from playslot_rl.datasets.survey import Survey
from playslot_rl.errors import ConfigError
from playslot_rl.modules.savi import SAVi
from playslot_rl.recipes.play import open_studio
from playslot_rl.runs import Run
from playslot_rl.training.stage_slots import warm_start

pytestmark = pytest.mark.integration

QUICK = ("minutes=0.02", "adopt.slots=[2,3]", "adopt.prototypes=4")


def write_set(
    root: Path,
    lengths: tuple[int, ...],
    speed: int,
    cameras: tuple[str, ...] = ("top",),
    size: tuple[int, int] = (80, 96),
    video: bool = False,
) -> Path:
    """A square that moves over frames of a size, as images or videos, by LeRobot's own writer; no actions."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    shape = {"dtype": "video" if video else "image", "shape": (*size, 3), "names": ["height", "width", "channels"]}
    features: dict[str, Any] = {f"observation.images.{name}": shape for name in cameras}
    data = LeRobotDataset.create("me/any", fps=30, features=features, root=root, use_videos=video)
    scale = size[0] // 80
    for length in lengths:
        for t in range(length):
            frame = np.full((*size, 3), 60, np.uint8)
            frame[30 * scale : 50 * scale, scale * (10 + speed * t) : scale * (30 + speed * t)] = 220
            data.add_frame({**dict.fromkeys(features, frame), "task": "move"})
        data.save_episode(parallel_encoding=False)
    data.finalize()
    return root


@pytest.fixture(scope="module")
def any_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_set(tmp_path_factory.mktemp("any") / "set", (24, 30, 26, 24, 28), speed=2)


def test_a_set_that_nobody_prepared_becomes_a_world_model(
    any_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import playslot_rl

    monkeypatch.setattr(adoption, "TELLING", SHORTEST)  # trials although there is no time
    run = tmp_path / "run"
    done = smoke("adopt", f"data.root={any_set}", f"out={run}", *QUICK)
    made = json.loads((run / "adopt.json").read_text())["choices"]
    assert made["frame size"]["value"] == 64
    assert made["slots"]["value"] in (2, 3)
    assert made["prototypes"]["value"] == 4
    assert all(f"{name}: {choice['value']} (" in done.out for name, choice in made.items())
    assert f"playslot play run={run} data.root={any_set}" in done.out
    assert done.out.splitlines()[-1].startswith("verdict: not usable: ")
    assert json.loads((run / "inspect" / "inspect.json").read_text())["lines"]
    model = playslot_rl.load(run, device="cpu")
    assert model.world_model.slot_shape[0] == made["slots"]["value"]
    assert json.loads((run / "config.json").read_text())["data"]["stride"] == made["stride"]["value"]

    moved = shutil.copytree(any_set, tmp_path / "moved")
    again = smoke("adopt", f"data.root={moved}", f"out={run}", *QUICK)
    assert json.loads((run / "adopt.json").read_text())["choices"] == made
    assert again.out.count("finished before") == 2
    assert again.out.splitlines()[-1] == done.out.splitlines()[-1]
    longer = ("minutes=3", *QUICK[1:])
    refused("adopt", f"data.root={any_set}", f"out={run}", *longer, message="minutes: got 3.0, expected 0.02")
    other = write_set(tmp_path / "other", (24, 30, 26, 24, 28), speed=1)
    refused("adopt", f"data.root={other}", f"out={run}", *QUICK, message=r"data: got \w+, expected \w+, with which")


def test_an_adoption_of_before_goes_on_wherever_its_set_lies(tmp_path: Path) -> None:
    (tmp_path / "adopt.json").write_text(json.dumps({"facts": {"data.root": "set", "seed": 0}, "choices": {}}))
    assert adoption.Decisions(tmp_path, {"data": "0216", "seed": 0}, 0.0).facts["data"] == "0216"
    with pytest.raises(ConfigError, match="seed: got 1, expected 0"):
        adoption.Decisions(tmp_path, {"data": "0216", "seed": 1}, 0.0)


def test_the_settings_say_what_is_done_with_the_actions_between_two_kept_frames(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    seen = Survey(tmp_path, "top", 30.0, (64, 64), np.full(8, 100), 2, [], 0.0)
    decide = adoption.Decisions(tmp_path, {}, 0.0)
    for stride, width, how, said in (
        (8, 2, "mean", "note: data.stride=8: actions are the mean of so many; for absolute targets, grippers"),
        (8, 2, "last", ""),
        (1, 2, "mean", ""),
        (8, 0, "mean", ""),
    ):
        decide.made |= {name: {"value": n, "reason": ""} for name, n in (("frame size", 64), ("stride", stride))}
        config = compose(["env=video", f"data.stride_action={how}"], "adopt")
        made = adoption.for_frames(config, replace(seen, action_dim=width), decide)
        assert (made.data.stride, made.data.stride_action) == (stride, how)
        noted = capsys.readouterr().err
        assert noted.startswith(said)
        assert bool(noted) == bool(said)


@pytest.mark.slow
def test_videos_of_two_cameras_become_a_model_that_can_be_played(tmp_path: Path) -> None:
    root = write_set(tmp_path / "set", (24, 22, 26, 24, 23), 2, ("top", "side"), (480, 640), video=True)
    run = tmp_path / "run"
    smoke("adopt", f"data.root={root}", "data.camera=side", f"out={run}", *QUICK)
    config = compose([f"run={run}"], "play")
    assert (config.data.root, config.data.camera) == (str(root), "observation.images.side")
    studio = open_studio(config)
    try:
        session = studio.session()
        session.begin(studio.start(next(iter(studio.sources)), 1, 2))
        assert session.press(0).frame.shape == (64, 64, 3)
    finally:
        studio.close()


def test_what_cannot_be_adopted_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    run, out = tmp_path / "run", f"out={tmp_path / 'run'}"
    still = write_set(tmp_path / "still", (4, 4), speed=0)
    frames = write_set(tmp_path / "frames", (1, 1), speed=2)
    short = write_set(tmp_path / "short", (2, 1, 2, 6, 2), speed=2)
    for message, given in {
        "frames of observation.images.top that never change": (f"data.root={still}", out),
        "episodes of one frame": (f"data.root={frames}", out),
        r"got episodes of 2 frames \(median\), expected at least 3": (f"data.root={short}", out),
        "got top,side, expected one: adopt reads one camera": (f"data.root={still}", "data.camera=top,side", out),
    }.items():
        refused("adopt", *given, message=message)
    assert not run.exists()


def test_playing_refuses_frames_that_the_model_does_not_take(any_set: Path) -> None:
    refused("play", "run=pretrained", f"data.root={any_set}", message=r"data\.resize=true")


@pytest.mark.parametrize("preset", ["smoke", "compact", "paper"])
@pytest.mark.parametrize("size", [32, 64, 128])
def test_every_preset_has_a_savi_for_every_frame_size(preset: str, size: int) -> None:
    sizes = savi_for(compose([f"preset={preset}"], "adopt").model.savi, size)
    savi = SAVi(replace(sizes, decoder_channels=tuple(4 for _ in sizes.decoder_channels)), size)
    assert savi.decode(torch.zeros(1, sizes.n_slots, sizes.slot_dim)).frames.shape == (1, 3, size, size)


@pytest.mark.parametrize("seed", range(20))
def test_clips_fit_into_episodes_of_different_lengths(seed: int) -> None:
    """Into those held out, too, which are a twentieth of them: often one, and it may be the shortest."""
    draw = np.random.default_rng(seed)
    lengths = -(-draw.integers(40, 200, 20) // 8)
    longest, validation = clip_room(lengths, 3, 0.05, seed)
    training, held_out = split_episodes(len(lengths), validation, seed)
    assert lengths[held_out].max() >= longest
    assert (lengths[training] >= longest).mean() > 0.75
    few = np.array([1] * 9 + [12] * 11)
    longest, validation = clip_room(few, 3, 0.05, seed)
    assert longest == 12
    assert few[split_episodes(20, validation, seed)[1]].max() == 12


def test_a_trial_that_is_too_short_chooses_nothing() -> None:
    few = too_short(20, "nothing is seen", preset=4)
    assert few is not None
    assert few.value == 4
    assert "20 steps" in few.reason
    assert too_short(adoption.TELLING, "nothing is seen", preset=4) is None


def test_schedules_shrink_with_the_time_that_there_is() -> None:
    config = compose(["preset=compact"], "adopt")
    short = scheduled(config, "dynamics", config.dynamics.steps // 4, patience=3).dynamics
    assert short.teacher_steps == config.dynamics.teacher_steps // 4
    assert short.optim.warmup_steps == config.dynamics.optim.warmup_steps // 4
    assert (short.patience, short.validate_every) == (3, short.steps // 10)
    long = scheduled(config, "slots", 2 * config.slots.steps).slots
    assert long.optim.warmup_steps == config.slots.optim.warmup_steps
    assert steps_within(60, 0.5) == 120
    assert steps_within(0.1, 0.5) == SHORTEST


def test_slots_start_from_a_model_that_takes_scenes_apart(capsys: pytest.CaptureFixture[str]) -> None:
    config = compose(["env=video", "preset=compact"])
    start = config.slots.start_from
    savi = SAVi(replace(config.model.savi, n_slots=4), config.env.image_size)
    warm_start(savi, Run.open(start).load_savi(), start)  # refuses other sizes
    assert (start_for(start, 64), start_for("", 128)) == (start, "")
    assert capsys.readouterr().out == ""
    assert start_for(start, 128) == ""
    assert capsys.readouterr().out.startswith("note: frames of 128 pixels, other than those of slots.start_from=")
