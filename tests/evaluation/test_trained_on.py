"""What stages were trained on is told in one way, for report cards and for errors of actions, and held-out
demonstrations are shown to none, however their set is named.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from playslot_rl.config import DataConfig, ExperimentConfig
from playslot_rl.config.weights import data_roots
from playslot_rl.data import videos
from playslot_rl.data.demonstrations import split_demonstrations
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.weighted import weighted
from playslot_rl.errors import DataError
from playslot_rl.evaluation.actions import require_unseen
from playslot_rl.evaluation.held_out import hold_out, trained_on
from playslot_rl.training.taught import taught

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
    unlabelled = replace(source, origins=np.array(["pictures:a", "pictures:b", "c", "d"]))
    assert set(trained_on(unlabelled, SEEN, np.array([0, 1])).values()) == {None}, "they may be of versions before"
    told = {"slots": {"trained_on": ["pictures:b", "x"]}, "policy": {"trained_on": ["d"]}}
    assert trained_on(unlabelled, told, np.array([0])) == {"slots": 0, "policy": None}
    assert trained_on(unlabelled, told) == {"slots": 1, "policy": 1}


def opened(_: ExperimentConfig, roots: str) -> EpisodeFrames:
    """Six episodes of each set; origins are those of the folder and a number."""
    named = data_roots(roots)
    sets = []
    for root in named:
        name, starts = Path(root.path).expanduser().resolve().name, np.arange(0, 12, 2)
        one = EpisodeFrames(
            np.zeros((12, 8, 8, 3), np.uint8), starts, np.full(6, 2), np.zeros((12, 1), np.float32), None, name, 10.0,
            "", "camera", name=root.path, origins=np.array([f"{name}{number}" for number in range(6)]),
        )  # fmt: skip
        sets.append(one)
    return weighted(sets, [root.weight for root in named])


@pytest.mark.parametrize("tested", [0.0, 0.3])
@pytest.mark.parametrize("written", ["D", "./D", "D/", "E/../D", "~/D", "link", "{here}/D", "D:2"])
def test_no_stage_is_shown_a_held_out_demonstration_however_its_set_is_named(
    written: str, tested: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("D", "E", "R"):
        (tmp_path / name).mkdir()
    (tmp_path / "link").symlink_to("D")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setattr(videos, "open_configured", opened)
    written = written.format(here=tmp_path)
    for root, demos, last in [
        (f"R,{written}", "D", "D"),
        ("R,D", written, "D"),
        (f"{written},R", "", "R"),
        (written, "D", "D"),
        (written, "", "D"),
        (f"R,{written},E", "D,E", "E"),
        (f"R,{written}", "E,D", "D"),
    ]:
        config = ExperimentConfig(data=DataConfig(root=root, demos=demos, held_out=2, tested=tested))
        seen = videos.open_videos(config, root, "train-slots", False)
        assert seen.origins is not None
        assert not {f"{last}4", f"{last}5"} & {*seen.origins.tolist()}
        assert tested or len(seen.origins) == 6 * len(data_roots(root)) - 2
        policy = split_demonstrations(videos.open_videos(config, demos or root, "train-policy"), None, 2, 0)
        assert policy.held_out is not None
        assert trained_on(policy.held_out, {"slots": taught(seen, config, {}, False)}) == {"slots": 0}
