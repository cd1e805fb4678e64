"""Demonstrations of several tasks take turns: who is labelled, drawn, and held out is of all tasks, for every stage."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.compose import compose
from playslot_rl.config.weights import data_roots
from playslot_rl.data import videos
from playslot_rl.data.demonstrations import require_finite, split_demonstrations
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.turns import turns
from playslot_rl.data.views import by_turns, concatenate, recorded_tasks, views_of_one
from playslot_rl.data.weighted import weighted
from playslot_rl.errors import DataError
from playslot_rl.evaluation.held_out import trained_on
from playslot_rl.training.taught import taught

TASKS = {"reach": 12, "push": 12, "pick-place": 6}
SENTENCES = dict(zip(TASKS, compose(["env=metaworld", f"env.task={'+'.join(TASKS)}"]).env.sentences, strict=True))


def recorded(name: str, cameras: int = 1) -> EpisodeFrames:
    """Episodes of two and three frames by turns; the first pixel of each frame is the number of its row."""
    count, said = TASKS[name], SENTENCES[name]
    lengths = 2 + np.arange(count) % 2
    rows = int(lengths.sum())
    frames = np.zeros((rows, 8, 8, 3), np.uint8)
    frames[:, 0, 0, 0] = np.arange(rows)
    known = EpisodeFrames(
        frames, np.cumsum(lengths) - lengths, lengths, np.arange(rows, dtype=np.float32)[:, None] / 100, None, name,
        10.0, said, "front", name=name, tasks=np.array([said] * count),
        origins=np.array([f"{name}{number}" for number in range(count)]),
    )  # fmt: skip
    return views_of_one([replace(known, camera=f"camera{i}", fingerprint=f"{name}{i}") for i in range(cameras)])


@pytest.fixture(params=[1, 2], ids=["camera", "cameras"])
def cameras(request: pytest.FixtureRequest) -> int:
    return int(request.param)


@pytest.fixture
def sets(cameras: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> str:
    """The three sets, named one after the other."""

    def opened(_: ExperimentConfig, roots: str) -> EpisodeFrames:
        named = [recorded(Path(root.path).name, cameras) for root in data_roots(roots)]
        return weighted(named, [None] * len(named))

    for name in TASKS:
        (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(videos, "open_configured", opened)
    return ",".join(TASKS)


def of_tasks(source: EpisodeFrames) -> dict[str, int]:
    named = {said: name for name, said in SENTENCES.items()}
    return dict(Counter(named[task] for task in recorded_tasks(source)))


def in_order(source: EpisodeFrames) -> list[str]:
    """Where each recorded episode is from."""
    assert source.origins is not None
    return [str(origin) for origin in source.origins[source.first_views]]


@pytest.mark.parametrize("draw", [None, 0, 1, 2])
@pytest.mark.parametrize("tested", [0.0, 0.2])
def test_those_that_are_labelled_and_held_out_are_of_each_task(sets: str, draw: int | None, tested: float) -> None:
    config = compose(["env=metaworld", f"env.task={'+'.join(TASKS)}", f"data.demos={sets}", f"data.tested={tested}"])
    source = videos.open_videos(config, sets, "train-policy")
    split = split_demonstrations(source, 5, 5, 0, draw)
    assert split.held_out is not None
    assert tested or of_tasks(split.trained) == of_tasks(split.held_out) == {"reach": 2, "push": 2, "pick-place": 1}
    assert {*of_tasks(split.trained)} == {*of_tasks(split.held_out)} == {*TASKS}


def test_every_episode_keeps_its_frames_actions_and_origin(sets: str, cameras: int) -> None:
    config = compose(["env=metaworld", f"env.task={'+'.join(TASKS)}"])
    source = videos.open_videos(config, sets, "train-policy")
    seen = set()
    for part in (
        source,
        split_demonstrations(source, 5, 5, 0, 1).held_out,
        split_demonstrations(source, 5, 5, 0).trained,
    ):
        assert part is not None
        assert part.origins is not None
        for episode in range(part.episodes):
            rows, origin = part.episode_rows(episode), str(part.origins[episode])
            there = recorded(origin.rstrip("0123456789"))
            assert there.origins is not None
            number = int(np.flatnonzero(there.origins == origin)[0])
            expected = there.episode_rows(number)
            assert np.array_equal(part.frames[rows], there.frames[expected])
            assert np.array_equal(part.require_actions()[rows], there.require_actions()[expected])
            seen.add(origin)
    assert len(seen) == sum(TASKS.values())
    assert source.episodes == cameras * len(seen)


@pytest.mark.parametrize("tested", [0.0, 0.2])
@pytest.mark.parametrize("held", [3, 5, 10])
def test_a_world_model_is_shown_all_but_the_held_out_ones(sets: str, held: int, tested: float) -> None:
    config = compose(
        ["env=metaworld", f"env.task={'+'.join(TASKS)}", f"data.demos={sets}", f"data.held_out={held}",
         f"data.tested={tested}"]
    )  # fmt: skip
    seen = videos.open_videos(config, sets, "train-slots", False)
    assert {*of_tasks(seen)} == {*TASKS}
    assert tested or seen.recordings == sum(TASKS.values()) - held
    policy = split_demonstrations(videos.open_videos(config, sets, "train-policy"), None, held, 0)
    assert policy.held_out is not None
    assert trained_on(policy.held_out, {"slots": taught(seen, config, {}, False)}) == {"slots": 0}


def test_of_a_set_of_several_tasks_those_of_each_are_held_out(
    sets: str, cameras: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One set in which they lie one after the other, beside another."""
    whole = replace(
        concatenate([recorded("reach", cameras), recorded("push", cameras)]), fingerprint="both", name="both"
    )

    def opened(_: ExperimentConfig, roots: str) -> EpisodeFrames:
        named = [whole if root.path == "push" else recorded(root.path, cameras) for root in data_roots(roots)]
        return weighted(named, [None] * len(named))

    monkeypatch.setattr(videos, "open_configured", opened)
    config = compose(
        ["env=metaworld", f"env.task={'+'.join(TASKS)}", "data.demos=push,pick-place", "data.held_out=5"]
    )  # fmt: skip
    seen = videos.open_videos(config, "push,pick-place", "train-slots", False)
    assert of_tasks(seen) == {"reach": 10, "push": 10, "pick-place": 5}
    policy = split_demonstrations(videos.open_videos(config, "push,pick-place", "train-policy"), None, 5, 0)
    assert policy.held_out is not None
    assert trained_on(policy.held_out, {"slots": taught(seen, config, {}, False)}) == {"slots": 0}


def test_one_task_and_sets_that_take_turns_stay_as_they_are(sets: str) -> None:
    alone = compose(["env=metaworld", "env.task=reach"])
    assert (
        videos.open_videos(alone, sets, "train-policy").fingerprint == videos.open_configured(alone, sets).fingerprint
    )
    told = compose(["env=metaworld", f"env.task={'+'.join(TASKS)}"])
    once = videos.open_videos(told, sets, "train-policy")
    assert once.fingerprint != videos.open_configured(told, sets).fingerprint
    assert by_turns(once).fingerprint == once.fingerprint


@pytest.mark.parametrize("counts", [(1,), (7,), (3, 3), (1, 9), (5, 2, 8)])
def test_first_and_last_ones_are_in_proportion(counts: tuple[int, ...]) -> None:
    tasks = [str(i) for i, n in enumerate(counts) for _ in range(n)]
    order = turns(tasks)
    assert sorted(order.tolist()) == list(range(len(tasks)))
    for some in range(len(tasks) + 1):
        first, last = Counter(tasks[i] for i in order[:some]), Counter(tasks[i] for i in order[some:])
        for i, n in enumerate(counts):
            assert abs(first[str(i)] - some * n / len(tasks)) < 1 + len(counts) / 2
            assert abs(last[str(i)] - (len(tasks) - some) * n / len(tasks)) < 1 + len(counts) / 2
    for i in range(len(counts)):
        own = [number for number in order.tolist() if tasks[number] == str(i)]
        assert own == sorted(own), "of one task they stay in their order"


@pytest.mark.parametrize("draw", [None, 0, 1])
def test_labelled_demonstrations_are_those_with_actions_and_of_each_task_that_has_some(
    sets: str, cameras: int, draw: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of `push` there are videos alone; they are cloned, held out, and never labelled."""

    def opened(_: ExperimentConfig, roots: str) -> EpisodeFrames:
        named = [recorded(Path(root.path).name, cameras) for root in data_roots(roots)]
        return weighted([replace(s, actions=None) if s.name == "push" else s for s in named], [None] * len(named))

    monkeypatch.setattr(videos, "open_configured", opened)
    config = compose(["env=metaworld", f"env.task={'+'.join(TASKS)}", f"data.demos={sets}"])
    source = videos.open_videos(config, sets, "train-policy")
    every = split_demonstrations(source, None, 5, 0, draw)
    assert every.held_out is not None
    assert of_tasks(every.trained) == {"reach": 10, "push": 10, "pick-place": 5}
    assert of_tasks(every.held_out) == {"reach": 2, "push": 2, "pick-place": 1}
    few = split_demonstrations(source, 6, 5, 0, draw, acted=True).trained
    assert of_tasks(few) == {"reach": 4, "pick-place": 2}
    assert in_order(few) == in_order(every.trained)[:6]
    for labelled in (1, 6, 15):
        require_finite(every, labelled)
    with pytest.raises(DataError, match=r"^push: got no actions, expected some in all 16 .*: 15 have any; name those"):
        require_finite(every, 16)
