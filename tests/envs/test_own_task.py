"""A task of a user's package, the tutorial's, which draws itself: what is known of it, and what is refused early."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from playslot_rl.config import plugins
from playslot_rl.config.compose import compose

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
