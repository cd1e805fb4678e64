"""Data sets go both ways: plain LeRobot reads ours with time windows, and ours trains on what LeRobot wrote."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from damage import load

from playslot_rl import keys
from playslot_rl.data.source import open_sources

pytestmark = pytest.mark.integration


@pytest.mark.parametrize("made", ["as collected", "merged"])
def test_lerobot_reads_windows_of_ours_with_equal_frames(made: str, ours: Path, tmp_path: Path) -> None:
    import shutil

    root = ours
    if made == "merged":
        from playslot_rl.datasets.merge import merge

        root = tmp_path / "all"
        merge([ours, Path(shutil.copytree(ours, tmp_path / "copy"))], root)
    source = open_sources(root, cache=tmp_path / "cache")
    fps = round(source.fps)
    dataset = load(root, delta_timestamps={keys.FEATURE_IMAGE: [-1 / fps, 0.0, 1 / fps], keys.FEATURE_ACTION: [0.0]})
    assert len(dataset) == len(source.frames) > 0
    for episode in range(source.episodes):
        rows = source.episode_rows(episode)
        for row in rows:
            item = dataset[int(row)]
            window = np.clip([row - 1, row, row + 1], rows[0], rows[-1])
            pixels = np.rint(item[keys.FEATURE_IMAGE].numpy() * 255).transpose(0, 2, 3, 1)
            assert np.array_equal(pixels, source.frames[window])
            assert item[f"{keys.FEATURE_IMAGE}_is_pad"].tolist() == [row == rows[0], False, row == rows[-1]]
            assert source.actions is not None
            assert np.array_equal(item[keys.FEATURE_ACTION][0], source.actions[row])


@pytest.mark.parametrize("dtype", ["image", "video"])
def test_ours_trains_on_what_lerobot_wrote(dtype: str, tmp_path: Path) -> None:
    from commands import smoke
    from foreign import write_foreign

    root = write_foreign(tmp_path / "theirs", dtype, size=64)
    run = tmp_path / "run"
    smoke("train-slots", "env=video", f"data.root={root}", f"out={run}", "slots.steps=3")
    assert (run / "slots" / "checkpoint" / "weights.safetensors").is_file()
