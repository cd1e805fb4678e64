"""Several data sets, drawn from by weights."""

from __future__ import annotations

import contextlib
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from playslot_rl.config import DataConfig, EnvConfig
from playslot_rl.config.env import VariationConfig
from playslot_rl.data.action_limits import ActionLimits
from playslot_rl.data.clips import Clips
from playslot_rl.data.slot_cache import slot_cache
from playslot_rl.data.source import EpisodeFrames, open_sources
from playslot_rl.data.views import concatenate, episode_range, split_tested, views_of_one
from playslot_rl.data.weighted import open_configured, say_unlike, weighted
from playslot_rl.errors import DataError
from playslot_rl.modules.savi import SAVi
from playslot_rl.testing import tiny_config


def a_set(seed: int, lengths: list[int], **changes: object) -> EpisodeFrames:
    generator = np.random.default_rng(seed)
    count = np.array(lengths)
    made = EpisodeFrames(
        frames=generator.integers(0, 256, (sum(lengths), 32, 32, 3), np.uint8),
        starts=np.cumsum(count) - count,
        lengths=count,
        actions=generator.random((sum(lengths), 2), np.float32),
        seeds=None,
        fingerprint=f"{seed:016d}",
        fps=10.0,
        task="push",
        camera="top",
    )
    return replace(made, **changes)  # type: ignore[arg-type]


SMALL, LARGE = [4, 3], [6] * 20


@pytest.fixture
def two() -> EpisodeFrames:
    return weighted([a_set(0, SMALL), a_set(1, LARGE)], [2.0, 1.0])


def test_sets_are_drawn_by_weight_and_their_windows_alike(two: EpisodeFrames) -> None:
    clips = Clips(two, 3, 0.0, seed=0)
    first = clips.sample(30_000, np.random.default_rng(0))[:, 0]
    in_small = first < sum(SMALL)
    assert abs(in_small.mean() - 2 / 3) < 0.01
    starts, counts = np.unique(first[in_small], return_counts=True)
    assert starts.tolist() == [0, 1, 4]  # of 4 and of 3 frames
    assert np.abs(counts / counts.sum() - 1 / 3).max() < 0.02
    starts, counts = np.unique(first[~in_small], return_counts=True)
    assert len(starts) == 20 * 4
    assert counts.max() < 2 * counts.min()


def test_windows_stay_inside_an_episode_and_the_training_episodes(two: EpisodeFrames) -> None:
    clips = Clips(two, 3, 0.3, seed=1)
    rows = clips.sample(2000, np.random.default_rng(0))
    assert (np.diff(rows, axis=1) == 1).all()
    ends = two.starts + two.lengths
    assert set(np.searchsorted(ends, rows[:, 0], side="right")) <= set(clips.train_episodes.tolist())
    assert np.array_equal(np.searchsorted(ends, rows[:, 0], side="right"), np.searchsorted(ends, rows[:, -1], "right"))


def test_first_frames_are_drawn_by_weight_too(two: EpisodeFrames) -> None:
    first = Clips(two, 3, 0.0, seed=0).sample_first(9000, np.random.default_rng(0))
    assert set(first) == set(two.starts)
    assert abs((first < sum(SMALL)).mean() - 2 / 3) < 0.02


def test_the_draw_repeats_and_frames_are_not_copied(two: EpisodeFrames) -> None:
    clips = Clips(two, 3, 0.0, seed=0)
    assert np.array_equal(*(clips.sample(50, np.random.default_rng(7)) for _ in range(2)))
    small, large = two.frames.parts  # type: ignore[attr-defined]
    assert (len(small), len(large)) == (sum(SMALL), sum(LARGE))
    assert np.shares_memory(small, two.shares.sources[0].frames)  # type: ignore[union-attr,arg-type]


def test_weights_are_part_of_the_fingerprint_and_no_weights_are_as_before() -> None:
    sets = [a_set(0, SMALL), a_set(1, LARGE)]
    prints = {weighted(sets, weights).fingerprint for weights in ([2, 1], [1, 1], [1, 2], [None, None])}
    assert len(prints) == 4
    assert weighted(sets, [None, None]).fingerprint == concatenate(sets).fingerprint
    assert weighted(sets, [None, None]).shares is None
    assert weighted(sets[:1], [3.0]).fingerprint == sets[0].fingerprint


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": np.zeros((7, 64, 64, 3), np.uint8)}, "b: got frames of 64x64, expected 32x32 as in a"),
        ({"actions": np.zeros((7, 4), np.float32)}, "b: got actions of width 4, expected 2 as in a"),
        ({"fps": 20.0}, "b: got frames a second 20, expected 10 as in a"),
        ({"robot": "block_push"}, "b: got recordings of block_push, expected button_press as in a"),
    ],
)
def test_sets_that_do_not_agree_are_refused(change: dict[str, object], message: str) -> None:
    sets = [a_set(0, SMALL, robot="button_press", name="a"), a_set(1, SMALL, **({"name": "b"} | change))]
    with pytest.raises(DataError, match=message):
        weighted(sets, [1.0, 1.0])


def test_sets_without_weights_agree_in_frames_and_rate_and_the_rest_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    first = a_set(0, SMALL, robot="arm", name="a")
    with pytest.raises(DataError, match="b: got frames a second 20, expected 10 as in a: read sets of one kind"):
        concatenate([first, a_set(1, SMALL, fps=20.0, name="b")])
    wide = {"actions": np.zeros((7, 4), np.float32)}
    joined = concatenate([first, a_set(1, SMALL, name="b", robot="hand", camera="side", **wide)])
    said = capsys.readouterr().err.splitlines()
    for line, what in zip(said, ("recordings of hand", "actions of width 4", "frames of side"), strict=True):
        assert line.startswith(f"note: b: got {what}, expected ")
    assert (joined.camera, joined.actions) == ("top,side", None)
    concatenate([first, a_set(1, SMALL, name="b", robot="arm")])
    for joined in (concatenate, lambda sets: weighted(sets, [1.0, 2.0]), views_of_one):
        with pytest.raises(DataError, match=r"got the frames of .* twice, expected each recording once"):
            joined([first, replace(first, name="a/")])
    assert capsys.readouterr().err == ""


def test_a_set_without_a_window_is_refused(two: EpisodeFrames) -> None:
    with pytest.raises(DataError, match="got no window in set 1 of 2"):
        Clips(two, 5, 0.0, seed=0).sample(4, np.random.default_rng(0))


def test_some_of_the_episodes_keep_their_weights(two: EpisodeFrames) -> None:
    for some in (split_tested(two, 0.2)[0], episode_range(two, 1, 20)):
        shares = some.shares
        assert shares is not None
        small = shares.of(some.starts) == 0
        assert small.any()
        assert not small.all()
        first = Clips(some, 3, 0.0, seed=0).sample(6000, np.random.default_rng(0))[:, 0]
        assert abs((first < shares.ends[0]).mean() - 2 / 3) < 0.03
    part = episode_range(two, 1, 20)
    assert np.array_equal(part.frames[np.arange(5)], two.frames[np.arange(4, 9)])


def test_a_config_names_weights_and_a_plain_text_is_as_before(foreign_images: Path, tmp_path: Path) -> None:
    config = replace(tiny_config(), data=DataConfig(cache=str(tmp_path)))
    config = replace(config, env=replace(config.env, image_size=32))
    other = Path(shutil.copytree(foreign_images, tmp_path / "other"))
    with (other / "meta" / "info.json").open("a") as info:
        info.write("\n")  # one set twice would be refused
    both = open_configured(config, f"{foreign_images}:3,{other}")
    assert both.shares is not None
    assert both.shares.weights.tolist() == [3.0, 1.0]
    plain = open_configured(config, f"{foreign_images},{other}")
    assert plain.shares is None
    assert np.array_equal(plain.starts, both.starts)
    assert (
        open_configured(config, str(foreign_images)).fingerprint
        == open_sources(foreign_images, cache=tmp_path).fingerprint
    )
    (tmp_path / "link").symlink_to(foreign_images)
    assert len(open_sources(tmp_path / "link", cache=tmp_path).frames) == 15
    assert len([entry for entry in (tmp_path / "frames").iterdir() if entry.is_dir()]) == 2  # one content, one cache


def test_slots_are_parsed_once_for_each_set_whatever_the_weights(
    two: EpisodeFrames, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch.manual_seed(0)
    savi = SAVi(replace(tiny_config().model.savi, decoder_channels=(16, 16)), 32)
    parts = [slot_cache(source, savi, "f" * 16, tmp_path) for source in two.shares.sources]  # type: ignore[union-attr]
    monkeypatch.setattr(SAVi, "forward", None)
    other = weighted([a_set(0, SMALL), a_set(1, LARGE)], [1.0, 5.0])
    for source in (two, other):
        slots = slot_cache(source, savi, "f" * 16, tmp_path)
        assert len(slots) == sum(SMALL) + sum(LARGE)
        assert np.array_equal(slots[np.array([[0, 7], [126, 6]])], np.concatenate(parts)[[[0, 7], [126, 6]]])


@pytest.mark.parametrize(
    ("recorded", "asked", "message"),
    [
        ({"task": "reach"}, {"task": "reach", "camera": "near"}, "recorded with env.camera=, expected env.camera=near"),
        (
            {"task": "push", "camera": "near"},
            {"task": "push"},
            "expected env.camera=: record them anew, or set",
        ),
        (
            {"task": "push", "camera": "near"},
            {"task": "drawer-open"},
            "expected env.camera=: record them anew, or name",
        ),
        ({"task": "drawer-open"}, {"task": "reach+drawer-open", "camera": "near"}, ""),
        ({"task": "reach", "camera": "near"}, {"task": "reach+drawer-open", "camera": "near"}, ""),
    ],
)
@pytest.mark.parametrize("merged", [False, True])
def test_frames_of_another_view_of_the_task_are_refused(
    foreign_images: Path, tmp_path: Path, recorded: dict[str, str], asked: dict[str, str], message: str, merged: bool
) -> None:
    root = shutil.copytree(foreign_images, tmp_path / "set")
    note = {"spec": {"env": {"name": "metaworld", **recorded}}}
    record = {"episodes": [], **({"sources": [{"name": "a"}, note]} if merged else note)}
    (root / "meta/playslot.json").write_text(json.dumps(record))
    config = replace(tiny_config(), data=DataConfig(cache=str(tmp_path / "cache"), resize=True))
    config = replace(config, env=EnvConfig("metaworld", image_size=32, **asked))  # type: ignore[arg-type]
    with pytest.raises(DataError, match=re.escape(message)) if message else contextlib.nullcontext():
        open_configured(config, str(root))


def test_demonstrations_that_were_recorded_otherwise_are_said(
    foreign_images: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = shutil.copytree(foreign_images, tmp_path / "set")
    seen = {"name": "gym", "id": "FetchReach-v4", "variation": {"background": True, "seed": 3}}
    (root / "meta/playslot.json").write_text(json.dumps({"episodes": [], "spec": {"env": seen}}))
    for typed, said in (
        ({"id": "FetchReach-v4"}, "demonstrations of env.variation={'background': True}, taken for off"),
        ({"id": "Reacher-v5"}, "demonstrations of env.id=FetchReach-v4, taken for Reacher-v5"),
    ):
        say_unlike(EnvConfig("gym", **typed), f"{root}:2")
        assert said in capsys.readouterr().err
    say_unlike(EnvConfig("gym", id="FetchReach-v4", variation=VariationConfig(background=True)), str(root))
    say_unlike(EnvConfig("button_press"), str(root))
    assert not capsys.readouterr().err


@pytest.mark.parametrize("order", [("pan", "lift"), ("lift", "pan"), ("x", "y")])
def test_columns_of_the_same_names_in_another_order_are_refused(order: tuple[str, str]) -> None:
    one = np.ones(2, np.float32)
    sets = [
        a_set(i, [4], limits=ActionLimits(names, -one, one, -one, one), name=f"set{i}")
        for i, names in enumerate((("pan", "lift"), order))
    ]
    wrong = order == ("lift", "pan")
    expected = "set1: got actions in the order lift, pan, expected pan, lift as in set0"
    with pytest.raises(DataError, match=expected) if wrong else contextlib.nullcontext():
        concatenate(sets)
