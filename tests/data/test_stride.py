"""Every k-th frame: the rows, and the actions that lead from one kept row to the next."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from playslot_rl.config import to_dict
from playslot_rl.config.compose import compose
from playslot_rl.data.demonstrations import say_averaged
from playslot_rl.data.source import open_sources
from playslot_rl.data.views import every
from playslot_rl.data.weighted import open_configured


def test_rows_of_each_episode_from_its_first_frame_on(foreign_images: Path, tmp_path: Path) -> None:
    source = open_sources(foreign_images, cache=tmp_path)  # episodes of 5, 3 and 7 frames
    kept = every(source, 3)
    assert kept.lengths.tolist() == [2, 1, 3]
    assert kept.starts.tolist() == [0, 2, 3]
    rows = [0, 3, 5, 8, 11, 14]
    assert np.array_equal(kept.frames[:], np.asarray(source.frames)[rows])
    assert np.array_equal(kept.frames[np.array([[1, 4]])], np.asarray(source.frames)[[[3, 11]]])
    assert (len(kept.frames), kept.frames.shape) == (6, (6, 32, 32, 3))
    assert kept.fps == pytest.approx(10 / 3)


def test_an_action_is_the_mean_of_those_up_to_the_next_kept_row(foreign_images: Path, tmp_path: Path) -> None:
    kept = every(open_sources(foreign_images, cache=tmp_path), 3)
    # The t-th action is (t, -t); an episode's last one is padding.
    assert kept.require_actions()[:, 0].tolist() == [1, 3, 0.5, 1, 4, 6]


def test_the_last_action_is_that_of_the_row_before_the_next_kept_one(foreign_images: Path, tmp_path: Path) -> None:
    source = open_sources(foreign_images, cache=tmp_path)
    kept = every(source, 3, "last")
    assert kept.require_actions()[:, 0].tolist() == [2, 3, 1, 2, 5, 6]
    assert np.array_equal(kept.frames[:], every(source, 3).frames[:])
    assert kept.fingerprint != every(source, 3).fingerprint == every(source, 3, "mean").fingerprint


def test_the_config_chooses_it_and_names_it_only_then(foreign_images: Path, tmp_path: Path) -> None:
    asked = [f"data.cache={tmp_path}", "data.stride=3", "env.image_size=32", "env=video", "preset=smoke"]
    averaged, last = compose(asked), compose([*asked, "data.stride_action=last"])
    assert open_configured(last, [foreign_images]).require_actions()[:, 0].tolist() == [2, 3, 1, 2, 5, 6]
    assert to_dict(last)["data"]["stride_action"] == "last"
    assert "stride_action" not in to_dict(averaged)["data"]  # as in configs from before the key


def test_another_stride_is_another_data_set_and_one_is_the_set_itself(foreign_images: Path, tmp_path: Path) -> None:
    source = open_sources(foreign_images, cache=tmp_path)
    assert every(source, 1) is source
    assert len({every(source, stride).fingerprint for stride in (1, 2, 3)}) == 3
    with pytest.raises(ValueError, match="got 0, expected 1"):
        every(source, 0)


def test_who_clones_averaged_actions_is_told_so_once(capsys: pytest.CaptureFixture[str]) -> None:
    for typed in ("data.stride=1", "data.stride=7", "data.stride=7", "data.stride=9 data.stride_action=last"):
        say_averaged(compose(["env=video", *typed.split()]).data)
    said = capsys.readouterr().err
    assert said.startswith("note: data.stride=7: actions are the mean of so many; for absolute targets")
    assert said.count("\n") == 1
