"""The range of a data set's actions: from its statistics, and from its data where these cannot be used."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from robot import robot_actions, write_robot

from playslot_rl.config import EnvConfig
from playslot_rl.config.compose import compose
from playslot_rl.data.action_limits import ActionLimits, joined_limits, limits_of, other_units, said, scaled
from playslot_rl.data.agreement import say_once
from playslot_rl.data.contents import Contents
from playslot_rl.data.source import labels_of
from playslot_rl.data.weighted import open_configured, say_foreign


def joints(rows: int = 400) -> np.ndarray[Any, Any]:
    """Degrees, a constant and a gripper."""
    generator = np.random.default_rng(0)
    return np.stack([generator.uniform(-90, 90, rows), np.full(rows, 7.3), generator.uniform(0, 100, rows)], 1).astype(
        np.float32
    )


def files(
    root: Path,
    actions: np.ndarray[Any, Any],
    stats: Any = None,
    names: Any = ("pan", "lift", "grip"),
    robot: Any = None,
) -> Contents:
    """A data set's metadata, as far as they are looked at."""
    (root / "meta").mkdir(exist_ok=True)
    if stats is not None:
        (root / "meta" / "stats.json").write_text(stats if isinstance(stats, str) else json.dumps({"action": stats}))
    names = list(names) if isinstance(names, tuple) else names
    info = {
        "robot_type": robot,
        "features": {"action": {"dtype": str(actions.dtype), "shape": list(actions.shape[1:]), "names": names}},
    }
    return Contents(root, info, [], {}, [], [len(actions)], {"action": actions})


def found(root: Path, actions: np.ndarray[Any, Any], **given: Any) -> ActionLimits:
    read = limits_of(files(root, actions, **given), actions.astype(np.float32).reshape(len(actions), -1))
    assert read is not None
    return read


def test_a_dimensions_range_is_what_the_statistics_say(tmp_path: Path) -> None:
    stats = {"min": [-100.0, 7.3, 0.0], "max": [95.0, 7.3, 100.0], "mean": [0, 7.3, 50]}
    limits = found(tmp_path, joints(), stats=stats)
    assert limits.low.tolist() == np.float32([-100, 7.3, 0]).tolist()
    assert limits.high.tolist() == np.float32([95, 7.3, 100]).tolist()
    assert said(limits.plain()) == "pan -100..95, lift 7.3 (constant), grip 0..100"
    assert not limits.quantiles.any()


@pytest.mark.parametrize(
    "stats",
    [
        None,
        "no json",
        "[]",
        '{"observation.state": {}}',
        {"min": [float("nan")] * 3, "max": [float("nan")] * 3},
        {"min": [float("-inf"), 7.3, 0.0], "max": [float("inf"), 7.3, 100.0]},
        {"min": [-90.0], "max": [90.0]},
        {"min": [[-90.0, 0.0]], "max": [[90.0, 9.0]]},
        {"min": -90.0, "max": 90.0},
        {"min": None, "max": None},
        {"min": ["a", "b", "c"], "max": [1, 2, 3]},
        {"min": [90.0, 7.3, 0.0], "max": [-90.0, 7.3, 100.0]},
        {"min": [0.0, 0.0, 0.0], "max": [0.0, 0.0, 0.0]},
        {"min": [-1e300, 7.3, 0.0], "max": [1e300, 7.3, 100.0]},
        {"mean": [0.0, 7.3, 50.0]},
        {"min": [-(10**400), 7, 0], "max": [10**400, 8, 100]},
        {"min": [-1e6, -1e6, -1e6], "max": [1e6, 1e6, 1e6]},
        {"min": [-1e6, 7.2, -900.0], "max": [90.0, 7.4, 900.0]},
    ],
)
def test_statistics_that_cannot_be_used_are_computed_from_the_data(tmp_path: Path, stats: Any) -> None:
    actions = joints()
    limits = found(tmp_path, actions, stats=stats)
    assert limits.low.tolist() == actions.min(axis=0).tolist()
    assert limits.high.tolist() == actions.max(axis=0).tolist()


def test_values_that_are_no_numbers_are_left_out(tmp_path: Path) -> None:
    actions = joints()
    clean = found(tmp_path, actions)
    actions[5:8] = np.nan
    actions[20, 0], actions[21, 2] = np.inf, -np.inf
    limits = found(tmp_path, actions, stats={"min": [float("nan")] * 3, "max": [float("nan")] * 3})
    assert np.isfinite([limits.low, limits.high]).all()
    assert np.abs(limits.low - clean.low).max() < 2
    actions[:, 1] = np.nan
    assert found(tmp_path, actions).low[1] == found(tmp_path, actions).high[1] == 0


def test_quantiles_where_there_are_outliers_and_a_line_that_says_what_is_clipped(tmp_path: Path) -> None:
    actions = joints()
    actions[17, 0] = 4e4
    stats = {
        "min": actions.min(0).tolist(),
        "max": actions.max(0).tolist(),
        "q01": [-89, 7.3, 1],
        "q99": [2e4, 7.3, 99],
    }
    limits = found(tmp_path, actions, stats=stats)
    assert limits.quantiles.tolist() == [True, False, False]
    assert -90 < limits.low[0] < -85
    assert 85 < limits.high[0] < 90, "LeRobot's q99, a mean over episodes, is carried off"
    share = 100 * np.mean((actions[:, 0] < limits.low[0]) | (actions[:, 0] > limits.high[0]))
    line = limits.line(actions)
    assert f"pan by quantiles (all: {actions[:, 0].min():.6g}..40000), {share:.2g} % of its values clipped" in line
    assert "\n" not in line
    assert limits.plain()["quantiles"] == ["pan"]


def test_a_gripper_that_seldom_opens_is_no_outlier(tmp_path: Path) -> None:
    actions = joints(2000)
    actions[:, 2] = np.random.default_rng(1).normal(0, 0.1, 2000)
    actions[500:515, 2] = 100
    limits = found(tmp_path, actions)
    assert not limits.quantiles.any()
    assert limits.high[2] == 100


def test_a_single_wrong_reading_does_not_move_what_never_moves(tmp_path: Path) -> None:
    actions = joints()
    actions[3, 1] = 900
    limits = found(tmp_path, actions)
    assert limits.low[1] == limits.high[1] == np.float32(7.3)


@pytest.mark.parametrize("dtype", ["int64", "int8", "bool", "float64", "float16", "uint8"])
def test_other_types_than_float32_are_read(tmp_path: Path, dtype: str) -> None:
    actions = (joints() > 20) if dtype == "bool" else joints().clip(0, 100).astype(dtype)
    contents = files(tmp_path, actions)
    read = labels_of(contents)["actions"]
    assert read.dtype == np.float32
    limits = limits_of(contents, read)
    assert limits is not None
    assert limits.high.tolist() == actions.max(axis=0).astype(np.float32).tolist()


@pytest.mark.parametrize(("value", "lines"), [(2**24, 0), (2**24 + 1, 1), (2**62 + 1, 1)])
def test_whole_numbers_that_float32_rounds_are_noted(
    tmp_path: Path, value: int, lines: int, capsys: pytest.CaptureFixture[str]
) -> None:
    read = labels_of(files(tmp_path, np.full((4, 3), value, np.int64)))["actions"]
    assert read.dtype == np.float32
    said_so = capsys.readouterr().err
    assert (
        said_so.count("\n") == said_so.count("action has whole numbers beyond 16777216, which float32 rounds") == lines
    )


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["a", "b", "c"], ("a", "b", "c")),
        ({"motors": ["a", "b", "c"]}, ("a", "b", "c")),
        ({"left": ["a"], "right": ["b", "c"]}, ("a", "b", "c")),
        ({"b": 1, "a": 0, "c": 2}, ("a", "b", "c")),
        ({"a": {}, "b": {}, "c": {}}, ("a", "b", "c")),
        (None, ("action_0", "action_1", "action_2")),
        (["a", "b"], ("action_0", "action_1", "action_2")),
        (["a", "a", "b"], ("action_0", "action_1", "action_2")),
        ("abc", ("action_0", "action_1", "action_2")),
        (["a\nb", " ", 5], ("a b", "action_1", "5")),
        (["\x1b[2Ja", "b\u202e", "c"], ("[2Ja", "b", "c")),
    ],
)
def test_the_dimensions_are_named_as_the_set_names_them(tmp_path: Path, names: Any, expected: tuple[str, ...]) -> None:
    assert found(tmp_path, joints(), names=names).names == expected


@pytest.mark.parametrize("robot", ["button_press", "block_push_easy", "grid_shapes"])
def test_sets_of_our_own_simulators_have_no_range_of_their_own(tmp_path: Path, robot: str) -> None:
    within = joints() / 100
    within[3] = np.nan
    assert limits_of(files(tmp_path, within, robot=robot), within) is None
    assert found(tmp_path, joints(), robot=robot).high[2] == joints()[:, 2].max(), "its name is no more than a name"
    (tmp_path / "meta" / "playslot.json").write_text("{}")
    assert limits_of(files(tmp_path, joints(), robot=robot), joints()) is None
    assert limits_of(files(tmp_path, joints()), None) is None


def test_a_range_that_is_stated_far_too_wide_is_said_once_and_no_other_joint_s_is_touched(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stats = {"min": [-1e6, 7.3, -10.0], "max": [1e6, 7.3, 110.0]}
    for _ in range(2):
        limits = found(tmp_path, joints(), stats=stats)
    assert limits.low.tolist() == [joints()[:, 0].min(), np.float32(7.3), -10]
    said_so = capsys.readouterr().err.splitlines()
    assert len(said_so) == 1
    assert "meta/stats.json says more than 3 times the range that the actions pan have" in said_so[0]


def test_several_sets_have_the_range_that_covers_them(tmp_path: Path) -> None:
    wide, narrow = joints(), joints() / 2
    limits = joined_limits([found(tmp_path, narrow), found(tmp_path, wide)], 3)
    assert limits is not None
    assert limits.low.tolist() == np.minimum(wide.min(0), narrow.min(0)).tolist()
    assert limits.high.tolist() == np.maximum(wide.max(0), narrow.max(0)).tolist()
    with_ours = joined_limits([None, found(tmp_path, narrow)], 3)
    assert with_ours is not None
    assert with_ours.low.tolist() == np.minimum(narrow.min(0), -1).tolist()
    assert joined_limits([None, None], 3) is None


def test_plain_values_say_whether_anything_is_scaled(tmp_path: Path) -> None:
    assert scaled(found(tmp_path, joints()).plain())
    unit = np.sign(joints()[:, [0, 0]])
    assert not scaled(found(tmp_path, unit, names=None).plain())
    assert not scaled(None)
    assert said(None) == "[-1, 1]"


@pytest.mark.parametrize(
    ("span", "other", "unlike"),
    [([180, 0, 100], [3.1, 0, 1.7], True), ([0.3, 0.2, 1], [300, 200, 1000], True), ([180, 0, 100], [90, 0, 1], False),
     ([0, 0], [1, 1], False)],
)  # fmt: skip
def test_another_unit_is_one_of_all_that_changes(span: list[float], other: list[float], unlike: bool) -> None:
    assert other_units(np.float32(span), np.float32(other)) == unlike


def test_a_robots_sets_in_two_units_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    turned = robot_actions()
    small = [np.radians(actions) for actions in turned]
    torn = [np.where(np.arange(len(actions))[:, None] == 3, 9e4, actions) for actions in turned]
    degrees, radians, damaged = (
        write_robot(tmp_path / name, actions)
        for name, actions in (("degrees", turned), ("radians", small), ("damaged", [torn[0], *turned[1:]]))
    )
    others, seen = write_robot(tmp_path / "others", small, robot="leg"), tmp_path / "seen"
    write_robot(seen, turned, labelled=False)
    own = compose(["preset=smoke", "env=video"])

    def told(*roots: Path) -> str:
        say_once.cache_clear()
        capsys.readouterr()  # LeRobot's own
        open_configured(own, roots)
        return "".join(line for line in capsys.readouterr().err.splitlines() if "units" in line)

    for roots in ((degrees,), (degrees, damaged), (degrees, others)):
        assert not told(*roots)
    for roots in ((degrees, radians), (seen, degrees, radians)):
        assert told(*roots).startswith(f"note: {radians}: got shoulder.pos ")
        assert f" in {degrees} shoulder.pos " in told(*roots)


FOREIGN = (
    "got robot_type=arm and no record of ours, taken for recordings of env=button_press: if they are a robot's own"
)


def test_a_robots_sets_that_are_taken_for_a_simulators_are_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arm, known = (
        write_robot(tmp_path / "arm", robot="arm\nnote: none"),
        write_robot(tmp_path / "a", robot="button_press"),
    )
    own = compose(["preset=smoke", "env=video"])
    source = open_configured(own, [arm])
    capsys.readouterr()
    say_foreign(EnvConfig(name="video"), source, str(arm))
    say_foreign(EnvConfig(), open_configured(own, [known]), str(known))
    assert not capsys.readouterr().err
    say_foreign(EnvConfig(), source, f"{known}:2,{arm}:1")
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"note: {arm}: {FOREIGN.replace('=arm', '=arm note: none')}")
