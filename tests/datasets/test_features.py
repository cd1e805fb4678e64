"""Features of one to three dimensions, bool and string, by LeRobot's writer: sound, and whole after every command."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from damage import EPISODES, ROWS, edit_column, load, put
from foreign_features import SHAPES, write_features

from playslot_rl.data.source import open_sources
from playslot_rl.datasets.merge import merge
from playslot_rl.datasets.repair import repair
from playslot_rl.datasets.split import split
from playslot_rl.datasets.statistics import QUANTILES
from playslot_rl.datasets.verify import verify

NUMBERS = [name for name, (dtype, _) in SHAPES.items() if dtype != "string"]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Episodes of 8 and 5 frames; look, do not touch."""
    return write_features(tmp_path_factory.mktemp("set") / "features")


def statistics(root: Path) -> dict[str, dict[str, Any]]:
    content: dict[str, dict[str, Any]] = json.loads((root / "meta/stats.json").read_text())
    return content


def same_as_lerobot(mine: dict[str, Any], theirs: dict[str, Any], spread: float) -> None:
    assert mine.keys() == theirs.keys()
    for key, value in theirs.items():
        assert np.shape(mine[key]) == np.shape(value), key
        # Their quantiles are read off a histogram of 5000 bins, ours are exact.
        np.testing.assert_allclose(mine[key], value, atol=spread if key in QUANTILES else 1e-5, err_msg=key)


@pytest.mark.integration
@pytest.mark.parametrize("lengths", [(8,), (8, 5), (1, 1), (2, 3)])
def test_what_lerobot_wrote_is_sound(lengths: tuple[int, ...], tmp_path: Path) -> None:
    result = verify(write_features(tmp_path / "set", lengths))
    assert (result.errors, result.warnings) == ((), ())


@pytest.mark.integration
@pytest.mark.parametrize(("name", "value"), [("height", None), ("joints", None), ("joints", [1.0, None, 2.0])])
def test_a_fraction_that_is_missing_is_nan_and_costs_its_episode_only(
    name: str, value: Any, written: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = Path(shutil.copytree(written, tmp_path / "set"))
    edit_column(root, ROWS, name, put(9, value))
    assert len(open_sources(root, cache=tmp_path / "cache").frames) == 13
    assert f"episode 1: got a value of {name} that is NaN" in capsys.readouterr().err
    assert not verify(root).ok
    assert verify(root, statistics=False).ok, "as a pull looks at it: nothing that a transfer damages"
    result = repair(root)
    assert (result.verification.episodes, len(result.lost)) == (1, 1)


@pytest.mark.integration
@pytest.mark.parametrize("name", ["closed", "words"])
def test_a_column_with_other_values_missing_is_left_out(
    name: str, written: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = Path(shutil.copytree(written, tmp_path / "set"))
    edit_column(root, ROWS, name, put(9, None))
    assert len(open_sources(root, cache=tmp_path / "cache").frames) == 13
    said = f"got column {name} with 1 missing values, expected none: it is left out"
    assert said in capsys.readouterr().err
    result = verify(root)
    assert (result.ok, len(result.warnings)) == (True, 1)
    edit_column(root, ROWS, "frame_index", put(9, None))
    assert "frame_index with 1 missing values" in verify(root).errors[0], "without which no row has a place"


@pytest.mark.integration
def test_lists_of_other_lengths_are_not_moved_into_each_others_rows(written: Path, tmp_path: Path) -> None:
    root = Path(shutil.copytree(written, tmp_path / "set"))
    table = pq.ParquetFile(root / ROWS).read()
    lists = table.column("joints").to_pylist()
    lists[:2] = [lists[0][:2], [*lists[1], 1.0]]
    place = table.schema.get_field_index("joints")
    pq.write_table(table.set_column(place, "joints", pa.array(lists, pa.list_(pa.float32()))), root / ROWS)
    assert "column joints with lists of 2 to 4 values, expected values of shape (3,)" in verify(root).errors[0]


@pytest.mark.integration
def test_repair_writes_the_statistics_of_lerobot(written: Path, tmp_path: Path) -> None:
    broken = Path(shutil.copytree(written, tmp_path / "broken"))
    (broken / "meta/stats.json").unlink()
    repair(broken)
    theirs, mine = statistics(written), statistics(broken)
    assert mine.keys() == theirs.keys()
    for name in NUMBERS:
        # An exact quantile is one of the values; the histogram's lies between two of them.
        same_as_lerobot(mine[name], theirs[name], spread=2.0)
    before, after = (pq.ParquetFile(root / EPISODES).read() for root in (written, broken))
    for name in NUMBERS:
        for key in ("min", "max", "mean", "std", "count"):
            column = f"stats/{name}/{key}"
            np.testing.assert_allclose(
                after.column(column).to_pylist(), before.column(column).to_pylist(), atol=1e-5, err_msg=column
            )
    dataset = load(broken)
    assert dataset[9]["pose"].shape == (4, 4)
    assert np.array_equal(dataset[9]["forces"].numpy(), load(written)[9]["forces"].numpy())


def test_a_wrong_statistic_of_a_matrix_is_noticed(written: Path, tmp_path: Path) -> None:
    broken = Path(shutil.copytree(written, tmp_path / "broken"))
    edit_column(broken, EPISODES, "stats/pose/mean", lambda rows: rows[0].__setitem__(2, 99.0))
    assert any("episode 0: got mean of pose" in line for line in verify(broken).errors)


def test_statistics_of_every_component_are_read_as_those_of_the_last_axis(written: Path, tmp_path: Path) -> None:
    """So this package once wrote them, and so LeRobot does for an episode of one frame."""
    import pyarrow as pa

    old = Path(shutil.copytree(written, tmp_path / "old"))
    path = old / EPISODES
    table = pq.ParquetFile(path).read()
    rows = pq.ParquetFile(old / "data/chunk-000/file-000.parquet").read().column("pose").to_pylist()
    poses = [np.array(rows[:8]), np.array(rows[8:])]
    for key in ("min", "max", "mean", "std"):
        stated = [getattr(pose, key)(0).tolist() for pose in poses]
        place = table.schema.get_field_index(f"stats/pose/{key}")
        table = table.set_column(place, f"stats/pose/{key}", pa.array(stated))
    pq.write_table(table, path)
    assert verify(old).errors == ()
    merge([old, written], tmp_path / "merged")
    assert np.shape(statistics(tmp_path / "merged")["pose"]["mean"]) == (4,)


@pytest.mark.integration
def test_split_and_merge_give_it_back(written: Path, tmp_path: Path) -> None:
    split(written, tmp_path / "parts", {"a": 0.5, "b": 0.5}, seed=0)
    merge([tmp_path / "parts/a", tmp_path / "parts/b"], tmp_path / "all")
    for name in NUMBERS:
        same_as_lerobot(statistics(tmp_path / "all")[name], statistics(written)[name], spread=0.01)
    there = load(tmp_path / "all")
    assert sorted(there[i]["words"] for i in range(len(there))) == sorted(load(written)[i]["words"] for i in range(13))
