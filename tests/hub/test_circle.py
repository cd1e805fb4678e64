"""The whole circle of every environment that ships: collected, verified, pushed, pulled, merged, split, trained on."""

from __future__ import annotations

import json
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from fake_hub import FakeHub

from playslot_rl.cli import main
from playslot_rl.datasets.fingerprint import content_fingerprint
from playslot_rl.datasets.merge import merge
from playslot_rl.datasets.split import split
from playslot_rl.datasets.verify import verify
from playslot_rl.envs import ENVIRONMENTS, PROCEDURAL

pytestmark = pytest.mark.integration

Client = Callable[..., dict[str, Any]]
EPISODES = 3


@pytest.mark.parametrize(
    "name",
    [
        name if name in ("button_press", "grid_shapes") else pytest.param(name, marks=pytest.mark.slow)
        for name in (*ENVIRONMENTS, *PROCEDURAL)
        if name != "gym" and not name.startswith("dmc_") and (name != "ogbench" or find_spec(name))
    ],
)
def test_the_whole_circle(name: str, hub: FakeHub, client: Client, tmp_path: Path) -> None:
    small = [f"env={name}", "preset=smoke", "threads=1", "device=cpu", "logging.progress=false"]
    policy = "random" if name in PROCEDURAL else "expert"
    collect = ["collect", *small, f"policy={policy}", f"episodes={EPISODES}", f"out={tmp_path / 'made'}", "workers=1"]
    assert main(collect) == 0
    made = verify(tmp_path / "made")
    assert (made.errors, made.warnings, made.episodes) == ((), (), EPISODES)

    pushed = client("push", root=tmp_path / "made", repo_id=f"owner/{name}", private=False)
    assert pushed["result"]["record"]["fingerprint"] == made.fingerprint
    assert pushed["result"]["record"]["frames"] == made.frames
    client("pull", root=tmp_path / "pulled", repo_id=f"owner/{name}")
    assert verify(tmp_path / "pulled").fingerprint == made.fingerprint

    both = merge([tmp_path / "made", tmp_path / "pulled"], tmp_path / "both")
    assert both.verification.episodes == 2 * EPISODES
    episodes = content_fingerprint(tmp_path / "made").episodes
    assert content_fingerprint(tmp_path / "both").episodes == episodes * 2
    parts = split(tmp_path / "both", tmp_path / "parts", {"train": 0.5, "val": 0.5})
    assert all(part.ok and part.episodes == EPISODES for part in parts.verifications.values())

    data = [f"data.root={tmp_path / 'parts' / 'train'}", f"data.cache={tmp_path / 'cache'}"]
    assert main(["train-slots", *small, *data, f"out={tmp_path / 'run'}", "slots.steps=1"]) == 0
    meta = json.loads((tmp_path / "run" / "slots" / "checkpoint" / "meta.json").read_text())
    assert meta["steps"] == 1


def test_features_of_every_kind_go_both_ways(hub: FakeHub, client: Client, tmp_path: Path) -> None:
    from foreign_features import write_features

    made = write_features(tmp_path / "made")
    pushed = client("push", root=made, repo_id="owner/features", private=False)
    assert pushed["result"]["record"]["fingerprint"] == verify(made).fingerprint
    client("pull", root=tmp_path / "pulled", repo_id="owner/features")
    assert verify(tmp_path / "pulled").fingerprint == verify(made).fingerprint
