"""A task of a user's package, the tutorial's, which draws itself: what is known of it, and what is refused early."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from playslot_rl.collectors.episodes import record
from playslot_rl.collectors.journal import CollectionSpec
from playslot_rl.config import EnvConfig, plugins
from playslot_rl.config.compose import compose
from playslot_rl.envs import check_task, has_parts, make_env, state_width
from playslot_rl.errors import ConfigError
from playslot_rl.evaluation.objects import evaluate_slots, validation_scores
from playslot_rl.runs import Run

PAGE = Path(__file__).parents[2] / "docs" / "tutorials" / "add-a-task.md"
Bring = Callable[..., list[str]]


@pytest.fixture
def bring(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bring]:
    """Installs the tutorial's task under a name, with changes `(old, new)` of its text; the arguments that name it."""

    def make(name: str, *changes: tuple[str, str]) -> list[str]:
        [text] = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.DOTALL | re.MULTILINE)
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        info = tmp_path / f"{name}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[playslot_rl.envs]\n{name} = {name}:TASK\n")
        (tmp_path / f"{name}.py").write_text(text.replace("reach_dot", name))
        plugins.brought.cache_clear()
        return [f"env={name}", "env.image_size=32"]

    monkeypatch.syspath_prepend(str(tmp_path))
    yield make
    monkeypatch.undo()
    plugins.brought.cache_clear()


def test_its_episodes_are_recorded_and_imagined_as_long_as_they_are_evaluated(bring: Bring) -> None:
    for typed, steps in (([], 20), (["env.max_steps=60"], 60), (["env.max_steps=10", "preset=paper"], 10)):
        config = compose([*bring(f"dot{steps}"), *typed])
        assert (config.env.max_steps, config.collect.random_steps, config.collect.expert_steps) == (steps,) * 3
        assert config.model.predictor.context == steps + 4
        assert config.dynamics.predicted_frames <= steps - 2
    smoke = compose([*bring("dot_smoke"), "preset=smoke", "env.max_steps=20"])
    assert (smoke.collect.random_steps, smoke.env.max_steps) == (6, 20)


def test_nobody_knows_its_parts_and_no_score_asks_for_them(bring: Bring, capsys: pytest.CaptureFixture[str]) -> None:
    config = compose([*bring("dot_parts"), "preset=smoke", "slots.segmented_episodes=1"])
    assert not has_parts(config.env)
    assert validation_scores(config) is None
    assert capsys.readouterr().out == ""
    with pytest.raises(ConfigError, match="protocol=slots: got env=dot_parts, which draws itself"):
        evaluate_slots(Run(Path("none")), Path("none"), config, "cpu")
    with pytest.raises(ConfigError, match="draws itself"):
        make_env(config.env).unwrapped.segment()  # type: ignore[attr-defined]
    assert has_parts(EnvConfig())
    assert has_parts(EnvConfig("grid_shapes"))
    own = "    def segment(self):\n        return np.zeros((32, 32), np.int64)\n\n    def _begin(self, rng):"
    labelled = compose([*bring("dot_labelled", ("    def _begin(self, rng):", own))])
    assert has_parts(labelled.env)


def test_its_state_is_as_wide_as_it_says(bring: Bring) -> None:
    wider = bring("dot_wider", ("(env or TASK.env, render_mode)", "(env or TASK.env, render_mode, state=5)"))
    assert state_width(compose(wider).env) == 5


def test_without_an_expert_it_is_recorded_at_random_and_an_expert_is_refused(bring: Bring) -> None:
    config = compose(bring("dot_alone", ("    def expert_action(self):", "    def _unused(self):")))
    check_task(config.env)
    assert next(record(CollectionSpec.make(config, "random", 1, 3, 0), [0])).actions.any()
    with pytest.raises(ConfigError, match="env=dot_alone: got a task without an expert, expected one that shows"):
        check_task(config.env, expert=True)
    with pytest.raises(ConfigError, match="env=dot_alone: got a task without an expert"):
        make_env(config.env).unwrapped.expert_action()  # type: ignore[attr-defined]


def test_random_actions_ask_no_expert(bring: Bring) -> None:
    fails = (
        "        ahead = ",
        "        raise RuntimeError('a state that the expert does not know')\n        ahead = ",
    )
    config = compose(bring("dot_lost", fails))
    assert make_env(config.env).unwrapped.has_expert  # type: ignore[attr-defined]
    assert next(record(CollectionSpec.make(config, "random", 1, 3, 0), [0])).actions.any()
    with pytest.raises(RuntimeError, match="does not know"):
        next(record(CollectionSpec.make(config, "expert", 1, 3, 0), [0]))


def test_a_variation_that_it_cannot_show_is_refused(bring: Bring) -> None:
    varied = compose([*bring("dot_varied"), "env.variation.background=true"]).env
    for use in (check_task, make_env):
        with pytest.raises(ConfigError, match=r"env\.variation: .*, expected none: env=dot_varied\S* draws itself"):
            use(varied)


def test_what_data_sets_say_of_it_is_asked_for_before_anything_is_recorded(bring: Bring) -> None:
    silent = bring("dot_silent", ('"control_hz": 10,', ""), ('"task": "Move the white square onto the red dot.", ', ""))
    with pytest.raises(ConfigError, match="env=dot_silent: got metadata without control_hz and task, expected"):
        CollectionSpec.make(compose(silent), "random", 1, 2, 0)
    CollectionSpec.make(compose(bring("dot_told")), "expert", 1, 2, 0)


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        (
            "float",
            "        return frame\n",
            "        return frame / 255.0\n",
            r"pixels float64 \(32, 32, 3\), expected uint8",
        ),
        ("small", "return frame\n", "return frame[:16]\n", r"pixels uint8 \(16, 32, 3\), expected uint8 \(32, 32, 3\)"),
        ("nothing", "return frame\n", "return None\n", r"pixels NoneType, expected uint8"),
        (
            "wide",
            "(self.square, self.dot)).as",
            "(self.square, self.dot, [1])).as",
            r"float32 \(5,\), expected float32 \(4,\)",
        ),
    ],
)
def test_what_is_no_frame_or_state_is_refused_at_the_first_look(
    bring: Bring, name: str, old: str, new: str, message: str
) -> None:
    config = compose([*bring(f"dot_{name}", (old, new)), "preset=smoke"])
    with pytest.raises(ConfigError, match=message) as caught:
        next(record(CollectionSpec.make(config, "random", 1, 2, 0), [0]))
    assert "\n" not in str(caught.value)


def test_the_recorded_action_is_the_one_that_was_executed(bring: Bring) -> None:
    """The expert of this task asks for more than an action can be."""
    config = compose(
        [*bring("dot_far", ("np.clip((self.dot - self.square) / 0.1, -1, 1)", "(self.dot - self.square) / 0.1"))]
    )
    spec = CollectionSpec.make(replace(config, collect=replace(config.collect, noise=0.0)), "expert", 1, 3, 0)
    (episode,) = record(spec, [0])
    assert np.abs(episode.actions).max() == 1.0
    moved = np.diff(episode.states[:, :2], axis=0)
    np.testing.assert_allclose(moved, 0.1 * episode.actions[:, :2], atol=1e-6)
