"""The fingerprint follows what a data set says, not how it is stored."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from damage import CAMERA, EPISODES, ROWS, edit_column, edit_json, put
from PIL import Image

from playslot_rl.datasets.fingerprint import content_fingerprint
from playslot_rl.errors import DataError


def test_it_stays_when_rows_are_packed_otherwise(broken: Path, images: Path) -> None:
    pq.write_table(pq.ParquetFile(broken / ROWS).read(), broken / ROWS, compression="zstd", row_group_size=4)

    def recompress(cells: list[Any]) -> None:
        for cell in cells:
            buffer = io.BytesIO()
            Image.open(io.BytesIO(cell["bytes"])).save(buffer, "PNG", compress_level=0)
            cell["bytes"] = buffer.getvalue()

    edit_column(broken, ROWS, CAMERA, recompress)
    assert (broken / ROWS).read_bytes() != (images / ROWS).read_bytes()
    assert content_fingerprint(broken) == content_fingerprint(images)


def test_it_stays_when_metadata_are_rewritten(broken: Path, images: Path) -> None:
    edit_json(broken, "meta/info.json", lambda info: info.update(robot_type="arm", splits={}, chunks_size=7))
    (broken / "meta/stats.json").write_text(json.dumps({}))
    assert content_fingerprint(broken) == content_fingerprint(images)


def test_it_changes_with_any_value_pixel_task_or_order(broken: Path, images: Path) -> None:
    before = content_fingerprint(images)
    edit_column(broken, ROWS, "action", put(7, [1.0, 2.0]))
    after = content_fingerprint(broken)
    assert [a == b for a, b in zip(before.episodes, after.episodes, strict=True)] == [True, False, True]
    assert after.value != before.value
    edit_column(broken, ROWS, "action", put(7, [2.0, -2.0]))
    assert content_fingerprint(broken) == before
    edit_column(broken, ROWS, CAMERA, lambda cells: cells[0].update(bytes=cells[1]["bytes"]))
    assert content_fingerprint(broken).episodes[0] != before.episodes[0]
    edit_json(broken, "meta/info.json", lambda info: info.update(fps=11))
    assert content_fingerprint(broken).value not in (before.value, after.value)


def test_a_damaged_data_set_has_none(broken: Path) -> None:
    (broken / EPISODES).write_bytes(b"nothing")
    with pytest.raises(DataError, match=r"cannot be read .*run `playslot dataset verify"):
        content_fingerprint(broken)
