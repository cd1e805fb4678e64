"""`playslot models`: the numbers are those of the files that ship."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import playslot_rl
from playslot_rl import cli
from playslot_rl.errors import CheckpointError
from playslot_rl.evaluation.card_lines import MEASURES
from playslot_rl.runs import Run
from playslot_rl.sharing.models import LICENCE, shipped_models

ENVS = ["button_press", "block_push_easy", "block_push"]


def test_every_shipped_model_is_listed_with_what_its_own_files_say(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["models", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row["name"] for row in rows] == ENVS
    for row in rows:
        run = Run.open(f"pretrained/{row['name']}")
        metas = [run.own(stage).meta for stage in ("slots", "dynamics", "policy")]
        assert row["psnr"] == pytest.approx(metas[0]["metrics"]["psnr"], abs=0.05)
        assert row["seconds"] == [round(meta["seconds"]) for meta in metas]
        assert row["videos"] == [metas[0]["episodes"], metas[2]["demos"], metas[2]["labelled_demos"]]
        assert 0 < row["fg_ari"] < 1
        for protocol in ("simulation", "imagination", "replay"):
            low, high = row[protocol]["interval"]
            assert low < sum(row[protocol]["value"]) / 2 < high
        assert sum(row["report_card"].values()) == len(MEASURES)


def test_the_lines_name_each_value(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["models", "run=pretrained/block_push_easy"]) == 0
    out = capsys.readouterr().out
    assert "89, 92 % (86 to 94 of both)" in out
    assert "BlockPush, four cubes" not in out


def test_the_licence_is_the_repositorys(repository: Path) -> None:
    assert "Apache License" in (repository / "LICENSE").read_text()
    assert LICENCE == "Apache-2.0"


@pytest.mark.parametrize("load", [lambda name: playslot_rl.load(f"pretrained/{name}"), shipped_models])
def test_an_unknown_name_is_told_the_nearest(load: object) -> None:
    assert callable(load)
    with pytest.raises(CheckpointError, match=r"env=blok_push, expected .*; did you mean pretrained/block_push\?$"):
        load("blok_push")
