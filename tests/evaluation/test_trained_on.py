"""What stages were trained on is told in one way, for report cards and for errors of actions."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from playslot_rl.config import DataConfig
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.errors import DataError
from playslot_rl.evaluation.actions import require_unseen
from playslot_rl.evaluation.held_out import hold_out, trained_on

SEEN: dict[str, dict[str, Any]] = {
    "slots": {"trained_on": ["a", "b"], "data": {"train": "x"}},
    "dynamics": {"trained_on": ["d", "elsewhere"], "data": {"train": "x"}},
}


@pytest.fixture
def source() -> EpisodeFrames:
    """Four episodes of two frames, a to d."""
    frames, starts = np.zeros((8, 8, 8, 3), np.uint8), np.arange(0, 8, 2)
    actions, names = np.zeros((8, 1), np.float32), np.array(["a", "b", "c", "d"])
    known = EpisodeFrames(frames, starts, np.full(4, 2), actions, None, "print", 10.0, "", "camera")
    return replace(known, origins=names)


def stages(metas: dict[str, dict[str, Any]]) -> Any:
    return {name: SimpleNamespace(meta=meta) for name, meta in metas.items()}


def test_episodes_are_counted_and_none_is_what_nobody_says(source: EpisodeFrames) -> None:
    metas = {**SEEN, "policy": {"data": {"demos": "x"}}}
    assert trained_on(source, metas) == {"slots": 2, "dynamics": 1, "policy": None}
    assert trained_on(source, metas, np.array([2, 3])) == {"slots": 0, "dynamics": 1, "policy": None}
    nameless = replace(source, origins=None)
    assert set(trained_on(nameless, metas).values()) == {None}


def test_report_cards_and_errors_agree(source: EpisodeFrames) -> None:
    with pytest.raises(DataError, match="got 2 of 4 episodes that slots, dynamics were trained on"):
        require_unseen(source, stages(SEEN), "")
    assert not hold_out(source, SEEN, DataConfig(held_out=1), 8).known, "dynamics saw the last one"
    apart = {**SEEN, "dynamics": {**SEEN["dynamics"], "trained_on": ["elsewhere"]}}
    assert hold_out(source, apart, DataConfig(held_out=1), 8).known
    silent = {**apart, "dynamics": {"data": {"train": "x"}}}
    assert not hold_out(source, silent, DataConfig(held_out=1), 8).known
    assert require_unseen(replace(source, origins=np.array(["p", "q", "r", "s"])), stages(silent), "") == ("dynamics",)
