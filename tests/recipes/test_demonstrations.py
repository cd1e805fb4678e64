"""Recording demonstrations: some more than are trained on, but none are added to a set that was begun without."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from playslot_rl.collectors import collection
from playslot_rl.collectors.collection import collect_demos
from playslot_rl.config.compose import compose

pytestmark = pytest.mark.integration


@pytest.mark.parametrize(
    ("begun", "record", "expected"),
    [
        (None, "", (8, 2)),
        (8, "expert/meta/playslot.json", (8, 2)),
        (6, "expert/meta/playslot.json", (6, 0)),
        (6, "expert.journal/collection.json", (6, 0)),
    ],
)
def test_a_set_begun_without_held_out_demonstrations_stays_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, begun: int | None, record: str, expected: tuple[int, int]
) -> None:
    asked: list[int] = []

    def collect(_config: Any, _policy: str, episodes: int, *_rest: Any) -> None:
        asked.append(episodes)

    monkeypatch.setattr(collection, "collect", collect)
    if begun is not None:
        path = tmp_path / "data" / record
        path.parent.mkdir(parents=True)
        spec = {"episodes": begun}
        path.write_text(json.dumps(spec if path.name == "collection.json" else {"spec": spec}))  # as each is written
    data = collect_demos(compose(["preset=smoke", "env=button_press"]), tmp_path)
    assert (asked, data.held_out) == ([expected[0]], expected[1])
    assert data.demos == str(tmp_path / "data" / "expert")


def test_a_set_that_the_user_names_is_taken_as_it_is(tmp_path: Path) -> None:
    config = compose(["preset=smoke", "env=button_press"])
    given = replace(config, data=replace(config.data, demos=str(tmp_path / "mine")))
    assert collect_demos(given, tmp_path) == given.data
