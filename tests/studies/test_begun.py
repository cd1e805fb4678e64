"""A comparison that was begun with other settings: refused by the name that was typed, or carried on."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from playslot_rl.config import ExperimentConfig, to_dict
from playslot_rl.config.compare import CompareConfig
from playslot_rl.config.compare_video import CompareVideoConfig
from playslot_rl.config.compose import compose
from playslot_rl.config.roles import without
from playslot_rl.errors import CheckpointError
from playslot_rl.storage.atomic import write_json
from playslot_rl.studies.success.jobs import success_config, success_jobs
from playslot_rl.studies.video.jobs import VideoJob, in_steps, video_config, video_jobs
from playslot_rl.studies.video.training import require_begun_alike, require_same_choice

CARRIED_ON: dict[str, Any] = {
    "methods": ("svg", "caddy", "playslot"),
    "seeds": (0, 1),
    "shown": (3, 1),
    "predicted": 9,
    "tested_on": ("random",),
    "episodes": 9,
    "clips": 9,
    "pictures": 1,
    "objects": (1, 2),
    "processes": 2,
    "launcher": "basic",
    "hydra": ("hydra.launcher.n_jobs=2",),
}
"""Settings of `compare-video` that make no training another one."""
REFUSED: dict[str, Any] = {"trained_seed": 3, "trained_frames": 3, "trial_steps": 9, "tested": 0.5}
AS_CHOSEN: dict[str, Any] = {"rates": (1.0, 9.0), "budget_minutes": 1.0}
"""Refused only where another learning rate or number of steps comes of it."""
OF_OTHER_CASES = ("vary", "values", "test")
"""Another variant is another job; a data set for the test has tests of its own below."""


def video(out: Path, **changes: Any) -> ExperimentConfig:
    """A comparison on some data set."""
    base = compose(["preset=smoke", "methods=svg,playslot", f"data.root={out}/data", f"out={out}"], "compare-video")
    launcher = {"launcher": "basic"} if "hydra" in changes else {}
    own = dataclasses.replace(base.compare_video, **launcher, **changes)
    data = dataclasses.replace(base.data, tested=0.0 if own.test else own.tested)
    return dataclasses.replace(base, compare_video=own, data=data)


def begin(config: ExperimentConfig, *, trained: bool = True) -> None:
    """Leave what a comparison leaves that was interrupted in its trials, or in its trainings."""
    out, own = Path(config.out), config.compare_video
    for job in video_jobs(config, out):
        wanted = video_config(config, job, "")
        for rate in own.rates:
            write_json(job.trial(rate) / "config.json", to_dict(in_steps(wanted, job.method, own.trial_steps)))
        if trained:
            write_json(job.run / "config.json", to_dict(wanted))


def test_every_setting_of_compare_video_is_in_a_table() -> None:
    names = {field.name for field in dataclasses.fields(CompareVideoConfig)}
    assert names == {*CARRIED_ON, *REFUSED, *AS_CHOSEN, *OF_OTHER_CASES}


@pytest.mark.parametrize("trained", [False, True])
@pytest.mark.parametrize("name", REFUSED)
def test_a_setting_of_a_begun_training_is_refused_by_its_own_name(tmp_path: Path, name: str, trained: bool) -> None:
    begin(before := video(tmp_path), trained=trained)
    after = video(tmp_path, **{name: REFUSED[name]})
    got, old = REFUSED[name], getattr(before.compare_video, name)
    with pytest.raises(CheckpointError) as caught:
        require_begun_alike(video_jobs(after, tmp_path), after.compare_video)
    text = str(caught.value)
    assert text.startswith(f"compare_video.{name}: got {got}, expected {old}, with which {tmp_path}/")
    assert text.endswith(f"set compare_video.{name} back, use another out=, or delete that folder")


@pytest.mark.parametrize("name", [*CARRIED_ON, *AS_CHOSEN])
def test_a_setting_that_no_begun_training_has_is_carried_on_with(tmp_path: Path, name: str) -> None:
    begin(before := video(tmp_path))
    after = video(tmp_path, **{name: (CARRIED_ON | AS_CHOSEN)[name]})
    require_begun_alike(video_jobs(after, tmp_path), after.compare_video)
    for job in set(video_jobs(before, tmp_path)) & set(video_jobs(after, tmp_path)):
        made, again = (without(video_config(config, job, ""), "machine") for config in (before, after))
        assert made | {"compare_video": ()} == again | {"compare_video": ()}


def test_a_data_set_for_the_test_keeps_no_episodes_back(tmp_path: Path) -> None:
    begin(video(tmp_path))
    after = video(tmp_path, test="data/test", tested=0.5)
    with pytest.raises(CheckpointError, match=r"^compare_video\.test: got data/test, expected nothing, with which"):
        require_begun_alike(video_jobs(after, tmp_path), after.compare_video)
    begin(after)
    another = video(tmp_path, test="data/another", tested=0.1)
    require_begun_alike(video_jobs(another, tmp_path), another.compare_video)


def test_trials_that_are_not_made_any_more_are_not_asked(tmp_path: Path) -> None:
    begin(video(tmp_path), trained=False)
    after = video(tmp_path, rates=(1.0,), trial_steps=9)
    require_begun_alike(video_jobs(after, tmp_path), after.compare_video)


@pytest.mark.parametrize(
    ("name", "value", "choice", "message"),
    [
        (
            "rates",
            (1.0, 9.0),
            {"rate": 9.0},
            r"compare_video\.rates: got \[1.0, 9.0\], .* a rate of 9, expected ",
        ),
        ("rates", (1.0, 9.0), {"rate": 3.0}, ""),
        (
            "budget_minutes",
            2.0,
            {"steps": 99},
            r"compare_video\.budget_minutes: got 2.0, .* 99 steps, expected ",
        ),
        ("budget_minutes", 2.0, {"steps": 4}, ""),
    ],
)
def test_trials_that_choose_otherwise_are_refused(
    tmp_path: Path, name: str, value: Any, choice: dict[str, Any], message: str
) -> None:
    begin(video(tmp_path))
    job, before = VideoJob("svg", 0, tmp_path), {"rate": 3.0, "steps": 4}
    after = video(tmp_path, **{name: value}).compare_video
    if not message:
        require_same_choice(job, after, before | choice, before)
        return
    with pytest.raises(CheckpointError, match=message):
        require_same_choice(job, after, before | choice, before)
    require_same_choice(job, after, before | choice, {})  # nothing was chosen before


COMPARE: dict[str, Any] = {
    "methods": ("playslot", "lapo", "dreamer"),
    "demos": (2, 3, 9),
    "labels": (1, 2),
    "seeds": (0, 1, 2),
    "online_seeds": (0,),
    "evaluation_seed": 7,
    "block": "test",
    "videos": (0, 2),
    "worlds": 2,
    "runs": "other",
    "reference": "lapo",
    "envs": ("block_push_easy",),
    "tasks": "other",
    "processes": 2,
    "launcher": "basic",
    "hydra": ("hydra.launcher.n_jobs=2",),
}


def test_every_setting_of_compare_is_in_the_table() -> None:
    assert set(COMPARE) == {field.name for field in dataclasses.fields(CompareConfig)}


@pytest.mark.parametrize("name", COMPARE)
def test_no_setting_of_compare_makes_a_begun_training_another_one(tmp_path: Path, name: str) -> None:
    """Jobs of the same name train alike, so that there is nothing to refuse."""
    before = compose(["preset=smoke", "methods=playslot,lapo,slot_oracle", "demos=2,3", "seeds=0,1"], "compare")
    with_it: dict[str, dict[str, Any]] = {
        "hydra": {"launcher": "basic"},
        "runs": {"worlds": 2},
        "videos": {"labels": (2,), "demos": CompareConfig.demos},
    }
    changes = {name: COMPARE[name], **with_it.get(name, {})}
    after = dataclasses.replace(before, compare=dataclasses.replace(before.compare, **changes))
    same = set(success_jobs(before, tmp_path)) & set(success_jobs(after, tmp_path))
    assert same
    for job in same:
        made, again = (without(success_config(config, job, ""), "machine") for config in (before, after))
        assert made == again
