"""A camera's short name is taken wherever it is unique; what is stored is the full one."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from foreign import write_foreign

from playslot_rl.config.compose import compose
from playslot_rl.data.contents import full_name, with_full_cameras
from playslot_rl.data.source import open_sources
from playslot_rl.datasets.survey import survey
from playslot_rl.errors import DataError
from playslot_rl.runs import Run

TOP, SIDE = "observation.images.top", "observation.images.side"
CAMERAS = [TOP, SIDE, "observation.depth.side", "observation.images.left.wrist", "observation.images.wrist"]


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_foreign(tmp_path_factory.mktemp("two") / "set", "image", size=64, cameras=("top", "side"))


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("top", TOP),
        ("images.top", TOP),
        (TOP, TOP),
        ("images.side", SIDE),
        ("left.wrist", "observation.images.left.wrist"),
        ("images.wrist", "observation.images.wrist"),
    ],
)
def test_a_unique_name_is_enough(typed: str, meant: str) -> None:
    assert full_name(typed, CAMERAS, "set") == meant


@pytest.mark.parametrize(
    ("typed", "message"),
    [
        (
            "side",
            r"data\.camera=side: set has 2 cameras of that name, expected one: say which of .*side, .*depth\.side",
        ),
        ("wrist", "set has 2 cameras of that name"),
        ("op", "set has no such camera, expected one of: observation.images.top, "),
        ("", "has no such camera"),
        ("Top", "has no such camera"),
    ],
)
def test_what_is_ambiguous_or_unknown_is_refused_with_the_list(typed: str, message: str) -> None:
    with pytest.raises(DataError, match=message) as refused:
        full_name(typed, CAMERAS, "set")
    assert "\n" not in str(refused.value)


def test_a_depth_map_is_no_camera_to_learn_from(two: Path, tmp_path: Path) -> None:
    root = Path(shutil.copytree(two, tmp_path / "set"))
    info = json.loads((root / "meta" / "info.json").read_text())
    info["features"][SIDE]["info"] = {"is_depth_map": True}
    (root / "meta" / "info.json").write_text(json.dumps(info))
    with pytest.raises(DataError, match=rf"data\.camera=side: got a depth map, .* {TOP}$"):
        open_sources(root, "side", tmp_path / "cache")
    assert open_sources(root, "", tmp_path / "cache").camera == TOP  # the only one of colours


def test_all_readers_take_the_short_name_for_the_same_frames(two: Path, tmp_path: Path) -> None:
    full, short = (open_sources(two, name, tmp_path) for name in (SIDE, "side"))
    assert (short.camera, short.fingerprint) == (SIDE, full.fingerprint)
    assert np.array_equal(short.frames, full.frames)
    streamed = open_sources(two, "side", tmp_path, buffer=8)
    assert (streamed.camera, streamed.fingerprint) == (SIDE, full.fingerprint)
    both = open_sources([two], f"top, {SIDE}", tmp_path)
    assert both.fingerprint == open_sources([two], f"{TOP},{SIDE}", tmp_path).fingerprint
    entries = [path for path in (tmp_path / "frames").iterdir() if path.is_dir()]
    assert len(entries) == 2, "one for each camera"


@pytest.mark.parametrize("typed", ["side", "top,side", SIDE, "", "nowhere"])
def test_a_run_stores_full_names(two: Path, tmp_path: Path, typed: str) -> None:
    config = compose(["preset=smoke", "env=video", f"data.root={two}", f"data.camera={typed}"])
    Run(tmp_path).store(config)
    stored = json.loads((tmp_path / "config.json").read_text())["data"]["camera"]
    assert stored == {"side": SIDE, "top,side": f"{TOP},{SIDE}"}.get(typed, typed)
    assert compose([f"run={tmp_path}"], "play").data.camera == stored


def test_looking_at_a_set_takes_it_too(two: Path) -> None:
    assert survey(two, "top").camera == TOP


def test_names_stay_where_there_is_nobody_to_ask(two: Path) -> None:
    for root in ("", "data/none", "hf://datasets/user/name"):
        config = compose([f"data.root={root}", "data.camera=top"])
        assert with_full_cameras(config) is config
    later = compose(["data.root=data/none", f"data.demos={two}", "data.camera=top"])
    assert with_full_cameras(later).data.camera == TOP
