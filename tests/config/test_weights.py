"""Data sets named with weights."""

from __future__ import annotations

from pathlib import Path

import pytest

from playslot_rl.config.weights import DataRoot, data_roots
from playslot_rl.errors import ConfigError


def test_plain_folders_have_no_weight() -> None:
    assert data_roots("a, b,,c") == [DataRoot("a", None), DataRoot("b", None), DataRoot("c", None)]
    assert data_roots("") == []


def test_folders_without_a_weight_among_others_count_once() -> None:
    assert data_roots("a:2,b:0.5,c") == [DataRoot("a", 2.0), DataRoot("b", 0.5), DataRoot("c", 1.0)]


@pytest.mark.parametrize("name", ["C:/sets/a", "host:sets", "a:2x", ":2"])
def test_a_colon_without_a_number_belongs_to_the_folder(name: str) -> None:
    assert data_roots(name) == [DataRoot(name, None)]


def test_a_folder_of_the_whole_name_wins_over_a_weight(tmp_path: Path) -> None:
    folder = tmp_path / "day:2"
    assert data_roots(str(folder)) == [DataRoot(str(tmp_path / "day"), 2.0)]
    folder.mkdir()
    assert data_roots(str(folder)) == [DataRoot(str(folder), None)]
    assert data_roots(f"{folder}:3") == [DataRoot(str(folder), 3.0)]


@pytest.mark.parametrize("weight", ["0", "-1", "nan", "inf"])
def test_weights_that_are_none_are_refused(weight: str) -> None:
    with pytest.raises(ConfigError, match="expected a number above 0"):
        data_roots(f"a:{weight},b")


def test_written_out_again_they_are_the_same() -> None:
    roots = data_roots("a:2,b:0.25,c")
    assert data_roots(",".join(root.text for root in roots)) == roots
