"""Our writer of stored images against LeRobot's own: the same rows, schema, metadata and statistics."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as parquet
import pytest

from playslot_rl import keys
from playslot_rl.collectors import export
from playslot_rl.collectors.journal import CollectionSpec, Journal, RecordedEpisode
from playslot_rl.config import ExperimentConfig, from_dict

EPISODES, STEPS, SIDE = 5, 4, 32


def fake_episode(spec: CollectionSpec, index: int) -> RecordedEpisode:
    rng = np.random.default_rng(index)
    side, steps = spec.env.image_size, spec.steps
    return RecordedEpisode(
        index,
        spec.episode_seed(index),
        index % 2,
        frames=rng.integers(0, 256, (steps + 1, side, side, 3), dtype=np.uint8),
        states=rng.normal(size=(steps + 1, 4)).astype(np.float32),
        actions=rng.uniform(-1, 1, (steps, 4)).astype(np.float32),
        rewards=rng.normal(size=steps).astype(np.float32),
        success=np.arange(steps) == index,
    )


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The same journal written by LeRobot's writer and by ours."""
    folder = tmp_path_factory.mktemp("pair")
    config = from_dict(ExperimentConfig, {"env": {"image_size": SIDE}, "logging": {"progress": False}})
    journal = Journal(folder / "journal", CollectionSpec.make(config, "random", EPISODES, STEPS, 0))
    for index in range(EPISODES):
        journal.add(fake_episode(journal.spec, index))
    with pytest.MonkeyPatch.context() as patch, export.quiet_datasets():
        export._write(folder / "ours", journal.spec, journal)
        patch.setattr(export, "_write_images", export._write_video)  # LeRobot's add_frame and save_episode
        export._write(folder / "theirs", journal.spec, journal)
    return folder / "ours", folder / "theirs"


def tables(root: Path, kind: str) -> Any:
    return parquet.read_table(next((root / kind).rglob("*.parquet")))


def test_rows_and_schema_are_lerobots(pair: tuple[Path, Path]) -> None:
    ours, theirs = (tables(root, "data") for root in pair)
    assert ours.schema.equals(theirs.schema)
    info = [json.loads(table.schema.metadata[b"huggingface"])["info"] for table in (ours, theirs)]
    assert info[0] == info[1]
    assert ours.num_rows == EPISODES * (STEPS + 1)
    for name in ours.column_names:
        assert ours[name].to_pylist() == theirs[name].to_pylist(), name  # PNG bytes and their names included


def test_episode_metadata_and_statistics_are_lerobots(pair: tuple[Path, Path]) -> None:
    ours, theirs = (tables(root, "meta/episodes") for root in pair)
    assert set(ours.column_names) == set(theirs.column_names)
    for name in ours.column_names:
        assert ours[name].to_pylist() == theirs[name].to_pylist(), name
    for file in ("info.json", "stats.json"):
        assert json.loads((pair[0] / "meta" / file).read_text()) == json.loads((pair[1] / "meta" / file).read_text())
    for root in pair:
        stats, info = (json.loads((root / "meta" / file).read_text()) for file in ("stats.json", "info.json"))
        assert list(stats) == [name for name in info["features"] if name in stats], "the same in every process"


@pytest.mark.integration
def test_large_sets_are_split_into_files_that_lerobot_reads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from lerobot.datasets import dataset_metadata
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from playslot_rl.collectors import image_set

    monkeypatch.setattr(image_set, "EPISODES_AT_ONCE", 2)
    monkeypatch.setattr(
        dataset_metadata.LeRobotDatasetMetadata, "data_files_size_in_mb", property(lambda self: 3 * 16_000 / 2**20)
    )
    config = from_dict(ExperimentConfig, {"env": {"image_size": SIDE}, "logging": {"progress": False}})
    journal = Journal(tmp_path / "journal", CollectionSpec.make(config, "random", EPISODES, STEPS, 0))
    for index in range(EPISODES):
        journal.add(fake_episode(journal.spec, index))
    export.export(journal, tmp_path / "data")
    files = sorted((tmp_path / "data" / "data").rglob("*.parquet"))
    assert len(files) > 1
    dataset = LeRobotDataset("any/thing", root=tmp_path / "data")
    for index in range(EPISODES):
        item = dataset[index * (STEPS + 1) + 2]
        image = np.rint(item[keys.FEATURE_IMAGE].numpy() * 255).transpose(1, 2, 0)
        np.testing.assert_array_equal(image, journal.read(index).frames[2])
        assert int(item["episode_index"]) == index
