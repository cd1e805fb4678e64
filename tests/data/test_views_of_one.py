"""Several cameras see one recorded episode: it is split, held out, drawn and counted as one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from foreign import write_foreign

from playslot_rl.config import DataConfig
from playslot_rl.data.agreement import say_once
from playslot_rl.data.clips import Clips
from playslot_rl.data.demonstrations import labelled_rows, split_demonstrations, transitions
from playslot_rl.data.source import EpisodeFrames, open_sources
from playslot_rl.data.views import concatenate, every, split_tested, views_of_one
from playslot_rl.data.weighted import weighted
from playslot_rl.evaluation.held_out import hold_out
from playslot_rl.training.demonstrated import cloned

LENGTHS = np.array([3, 1, 4, 2, 5, 3, 2, 4])


def seen_by(camera: int, first: int = 0) -> EpisodeFrames:
    """Every pixel of episode e is 10 (`first` + e) + `camera`."""
    numbers = np.repeat(np.arange(len(LENGTHS)) + first, LENGTHS)
    frames = np.broadcast_to(10 * numbers[:, None, None, None] + camera, (len(numbers), 4, 4, 3)).astype(np.uint8)
    return EpisodeFrames(
        frames, np.cumsum(LENGTHS) - LENGTHS, LENGTHS, np.repeat(numbers, 2).reshape(-1, 2).astype(np.float32),
        np.arange(len(LENGTHS)) + first, f"{camera}", 10.0, "", f"camera{camera}", name="set",
    )  # fmt: skip


@pytest.fixture
def both() -> EpisodeFrames:
    return views_of_one([seen_by(1), seen_by(2)])


def views(source: EpisodeFrames, chosen: Iterator[int] | list[int] | None = None) -> list[tuple[int, int]]:
    """Episode and camera of what is in a source, as its frames say, sorted."""
    episodes = range(source.episodes) if chosen is None else chosen
    frames = [source.frames[source.episode_rows(int(episode))] for episode in episodes]
    assert all((part == part.flat[0]).all() for part in frames)
    return sorted(divmod(int(part.flat[0]), 10) for part in frames)


def recorded(source: EpisodeFrames) -> set[int]:
    return {episode for episode, _ in views(source)}


def of_two_tasks(source: EpisodeFrames) -> EpisodeFrames:
    """Episodes 0 to 2 push, 3 to 7 reach."""
    return replace(source, tasks=np.where(source.numbers > 2, "reach", "push"))


def test_a_scene_is_a_task_before_a_camera(both: EpisodeFrames) -> None:
    assert len(set(seen_by(1).scenes)) == 1
    told = of_two_tasks(both)
    shown = [{(e > 2, camera) for e, camera in views(told, np.flatnonzero(told.scenes == n))} for n in set(told.scenes)]
    assert sorted(map(sorted, shown)) == [[(False, 1)], [(False, 2)], [(True, 1)], [(True, 2)]]


def test_clips_of_a_scene_are_its_own_and_scenes_of_few_episodes_are_one(both: EpisodeFrames) -> None:
    clips = Clips(of_two_tasks(both), 2, 0.0, 0)  # two episodes of two frames push, five reach

    def shown(least: int, most: int = 16) -> list[list[tuple[bool, int]]]:
        parts = [np.unique(both.frames[rows]).tolist() for rows in clips.scenes(least, most)]
        return [sorted({(value >= 30, value % 10) for value in part}) for part in parts]

    push, reach = [(False, 1), (False, 2)], [(True, 1), (True, 2)]
    assert shown(2) == [[scene] for scene in push + reach]
    assert shown(3) == [[scene] for scene in reach] + [push]
    assert shown(2, 1) == [reach[:1], push + reach[1:]]
    assert shown(8) == [push + reach]


def test_both_views_of_an_episode_lie_on_one_side_of_validation(both: EpisodeFrames) -> None:
    for seed in range(10):
        clips = Clips(both, 1, 0.3, seed)
        held = set(range(both.episodes)) - set(clips.train_episodes.tolist())
        sides = [
            {episode for episode, _ in views(both, sorted(part))} for part in (clips.train_episodes.tolist(), held)
        ]
        assert [len(side) for side in sides] == [6, 2]
        assert not sides[0] & sides[1]
        one = Clips(seen_by(1), 1, 0.3, seed)
        assert {e for e, _ in views(seen_by(1), one.train_episodes.tolist())} == sides[0], "as with one camera"


def test_what_a_run_is_measured_on_was_in_no_view_trained_on(both: EpisodeFrames) -> None:
    config = DataConfig(validation=0.3)
    found = hold_out(both, {"dynamics": {"data": {"train": both.fingerprint}, "seed": 3}}, config, 100)
    held = {e for e, _ in views(both, found.tested.tolist())}
    train = {e for e, _ in views(both, Clips(both, 1, 0.3, 3).train_episodes.tolist())}
    assert found.known
    assert not held & (train | {e for e, _ in views(both, found.fitted.tolist())})
    named = hold_out(both, {}, DataConfig(held_out=2), 100)
    assert views(both, named.tested.tolist()) == [(6, 1), (6, 2), (7, 1), (7, 2)]
    last = hold_out(both, {}, DataConfig(), 100)
    assert not {e for e, _ in views(both, last.tested.tolist())} & {e for e, _ in views(both, last.fitted.tolist())}
    split = split_demonstrations(both, 5, 2, 2, 0)
    policy = {"data": {"demos": split.trained.fingerprint}, "demos": 5, "held_out_demos": 2}
    world = {name: {"held_out": 2, "trained_on": ["0"]} for name in ("slots", "dynamics")}
    known = hold_out(replace(both, origins=both.numbers.astype(str)), {"policy": policy, **world}, DataConfig(), 100)
    assert (known.known, {e for e, _ in views(both, known.tested.tolist())}) == (True, {6, 7})


@pytest.mark.parametrize("draw", [None, 0, 1])
@pytest.mark.parametrize("demos", [None, 3])
def test_demonstrations_are_counted_and_held_out_as_they_were_recorded(
    both: EpisodeFrames, demos: int | None, draw: int | None
) -> None:
    split, one = (split_demonstrations(source, demos, 2, 2, draw) for source in (both, seen_by(1)))
    assert split.trained.recordings == one.trained.episodes == (demos or 6)
    assert recorded(split.trained) == recorded(one.trained)
    assert split.held_out is not None
    assert views(split.held_out) == [(6, 1), (6, 2), (7, 1), (7, 2)]
    assert split.held_out.actions is not None
    for episode in range(split.held_out.episodes):
        rows = split.held_out.episode_rows(episode)
        assert (split.held_out.actions[rows] == split.held_out.frames[rows][:, 0, 0, :2] // 10).all()
    moves, alone = transitions(split.trained), transitions(one.trained)
    assert moves.lengths.tolist() == alone.lengths.tolist(), "in the order of the draw"
    rows = moves.rows[labelled_rows(moves.episode, 2).numpy()]
    shown = alone.rows[labelled_rows(alone.episode, 2).numpy()]
    assert {*both.frames[rows].flat[::48] // 10} == {*one.trained.frames[shown].flat[::48] // 10}
    assert len(rows) == 2 * len(shown)
    count = int((one.trained.lengths >= 2).sum())
    line, facts = cloned("policy", split, 1, 2)
    assert line.startswith(f"policy: {count} demos, ")
    assert (line[-10:], facts["demos"]) == ("2 held out", count)


def test_a_test_keeps_whole_episodes_and_sets_side_by_side_stay_apart(both: EpisodeFrames) -> None:
    trained, tested = split_tested(both, 0.25)
    assert (trained.recordings, tested.recordings) == (6, 2)
    assert not recorded(trained) & recorded(tested)
    two = concatenate([every(both, 2), replace(seen_by(3, first=8), fps=5.0)])
    assert two.recordings == 16
    assert two.numbers.tolist() == [*range(8), *range(8), *range(8, 16)]
    held = split_demonstrations(trained, None, 2, 0).held_out
    assert held is not None
    assert held.episodes == 4


def test_the_rest_of_sets_with_weights_knows_whose_its_rows_are(both: EpisodeFrames) -> None:
    other = replace(views_of_one([seen_by(1, 8), seen_by(2, 8)]), name="other", fingerprint="other")
    joined = weighted([both, other], [1.0, 2.0])
    rest = split_demonstrations(joined, None, 9, 0).held_out
    assert rest is not None
    assert rest.shares is not None
    of_other = [bool((rest.frames[row] >= 80).all()) for row in rest.starts]
    assert rest.shares.of(rest.starts).astype(bool).tolist() == of_other


def test_cameras_of_a_folder_share_its_episodes(tmp_path: Path) -> None:
    root = write_foreign(tmp_path / "set", "image", cameras=("top", "side"))
    two = open_sources([root], "top,side", tmp_path / "cache")
    assert (two.episodes, two.recordings, two.numbers.tolist()) == (6, 3, [0, 1, 2, 0, 1, 2])
    assert open_sources([root], "top", tmp_path / "cache").recorded is None


def test_clips_say_whether_they_validate_on_what_is_trained_on(both: EpisodeFrames) -> None:
    alone = views_of_one(
        [replace(seen, starts=seen.starts[:1], lengths=seen.lengths[:1]) for seen in (seen_by(1), seen_by(2))]
    )
    said = [Clips(source, 1, share, 0).validated for source, share in ((both, 0.1), (both, 0.0), (alone, 0.5))]
    assert said == ["held-out", "training", "training"]


def test_episodes_that_no_clip_fits_in_are_said(both: EpisodeFrames, capsys: pytest.CaptureFixture[str]) -> None:
    say_once.cache_clear()
    Clips(both, 1, 0.25, 0).say_short()
    assert not capsys.readouterr().err
    Clips(both, 3, 0.25, 0).say_short()
    assert (
        capsys.readouterr().err
        == "note: set: 6 of 16 episodes have fewer frames than the window of 3: they are left out\n"
    )
