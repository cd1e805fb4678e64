"""Evaluation seeds stay away from training seeds."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from playslot_rl.config import DataConfig, EvaluationConfig, ExperimentConfig
from playslot_rl.errors import ConfigError, DataError
from playslot_rl.evaluation.held_out import check_disjoint, first_seed, recorded_seeds, training_seeds
from playslot_rl.seeds.episodes import episode_seed


def _data_set(root: Path, content: object) -> Path:
    (root / "meta").mkdir(parents=True)
    (root / "meta" / "playslot.json").write_text(json.dumps(content))
    return root


def test_seed_blocks_do_not_meet() -> None:
    config = ExperimentConfig()
    assert first_seed(config, 0) == config.evaluation.seed_offset
    assert first_seed(config, 1) - first_seed(config, 0) == 1_000_000
    assert first_seed(config, 4242) == episode_seed("evaluation", 4242, 0)


def _with_seeds(root: Path, *seeds: int) -> Path:
    return _data_set(root, {"spec": {"seed": 99}, "episodes": [{"seed": seed} for seed in seeds]})


def test_seeds_are_read_from_records_and_from_rows(tmp_path: Path) -> None:
    assert recorded_seeds(_with_seeds(tmp_path / "a", 5, 6)) == {5, 6}
    assert recorded_seeds(tmp_path / "none") == set()
    (tmp_path / "rows" / "data" / "chunk-000").mkdir(parents=True)
    for name, column in (("0", "seed"), ("1", "other")):
        pq.write_table(pa.table({column: [7, 7, 8]}), tmp_path / "rows" / "data" / "chunk-000" / f"{name}.parquet")
    assert recorded_seeds(tmp_path / "rows") == {7, 8}


def test_seeds_of_all_named_data_sets_and_of_the_run_are_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    _with_seeds(tmp_path / "run" / "data" / "expert", 3)
    _with_seeds(tmp_path / "b", 2)
    roots = f"{_with_seeds(tmp_path / 'a', 1)}, ~/b"
    config = replace(ExperimentConfig(), data=DataConfig(root=roots))
    assert training_seeds(config, tmp_path / "run") == {1, 2, 3}


def test_an_overlap_is_refused() -> None:
    check_disjoint([1, 2], {3})
    with pytest.raises(ConfigError, match="seed 2 that is in a training data set"):
        check_disjoint([1, 2], {2, 3})


def test_a_damaged_record_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "playslot.json").write_text("{")
    with pytest.raises(DataError, match="expected JSON"):
        recorded_seeds(tmp_path)


def test_offset_moves_the_seeds() -> None:
    assert first_seed(replace(ExperimentConfig(), evaluation=EvaluationConfig(seed_offset=7)), 0) == 7
