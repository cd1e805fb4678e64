"""Where episodes of the blocks family start, and which object each task means."""

from __future__ import annotations

from collections import Counter
from itertools import combinations

import numpy as np
import pytest

from playslot_rl.config import BlocksConfig
from playslot_rl.config.env import COLOURS
from playslot_rl.envs.block_layout import LIFT, REACH_Z, REDNESS, Layout, Variant, draw_layout

START = np.array([1.3419, 0.7491, 0.5347])


def layouts(variant: Variant, config: BlocksConfig, count: int = 60) -> list[Layout]:
    return [draw_layout(np.random.default_rng(seed), variant, config, START) for seed in range(count)]


@pytest.mark.parametrize("variant", ["push", "pick", "reach"])
@pytest.mark.parametrize("distractors", [0, 4])
def test_objects_and_goal_are_in_range_and_apart(variant: Variant, distractors: int) -> None:
    for layout in layouts(variant, BlocksConfig(distractors=distractors)):
        assert layout.places.shape == (distractors + 1, 3)
        assert layout.colours.shape == (distractors + 1, 3)
        assert np.abs(layout.places[:, :2] - START[:2]).max() <= 0.15
        assert np.abs(layout.goal[:2] - START[:2]).max() <= 0.15
        for a, b in combinations(layout.places[:, :2], 2):
            assert np.linalg.norm(a - b) >= 0.127
        if variant == "reach":
            np.testing.assert_array_equal(layout.goal, layout.places[layout.target])
            assert np.linalg.norm(layout.goal - START) >= 0.104
        else:
            assert np.linalg.norm(layout.places[:, :2] - layout.goal[:2], axis=1).min() >= 0.104


def test_cubes_rest_on_the_table_and_heights_are_the_variants() -> None:
    push, pick, reach = (layouts(v, BlocksConfig()) for v in ("push", "pick", "reach"))
    assert all((x.places[:, 2] == 0.445).all() and x.goal[2] == 0.445 for x in push)
    lifts = np.array([x.goal[2] - x.places[0, 2] for x in pick])
    assert LIFT[0] <= lifts.min() < lifts.max() <= LIFT[1]
    heights = np.concatenate([x.places[:, 2] for x in reach])
    assert REACH_Z[0] <= heights.min() < heights.max() <= REACH_Z[1]


def test_layouts_fill_the_square() -> None:
    places = np.concatenate([x.places for x in layouts("push", BlocksConfig(distractors=0), 200)])[:, :2] - START[:2]
    assert (places.max(axis=0) > 0.13).all()
    assert (places.min(axis=0) < -0.13).all()
    assert np.abs(places.mean(axis=0)).max() < 0.02


def test_the_number_of_distractors_is_drawn_from_its_range() -> None:
    counts = Counter(len(x.places) - 1 for x in layouts("push", BlocksConfig(distractors=1, distractors_to=3), 90))
    assert set(counts) == {1, 2, 3}
    assert min(counts.values()) > 15


def names(layout: Layout) -> list[str]:
    known = {colour: name for name, colour in COLOURS.items()}
    return [known[tuple(int(v) for v in colour)] for colour in layout.colours]


@pytest.mark.integration
@pytest.mark.parametrize("distractors", [0, 1, 2, 3, 4])
def test_each_task_means_the_object_it_says(distractors: int) -> None:
    for layout in layouts("push", BlocksConfig("red", distractors), 20):
        assert names(layout).count("red") == 1
        assert names(layout)[layout.target] == "red"
    for layout in layouts("push", BlocksConfig("reddest", distractors), 20):
        found = [REDNESS.index(name) for name in names(layout)]
        assert layout.target == int(np.argmin(found))
        assert len(set(names(layout))) == distractors + 1
    for layout in layouts("push", BlocksConfig("odd", distractors), 20):
        counts = Counter(names(layout))
        assert counts[names(layout)[layout.target]] == 1
        assert len(counts) == min(2, distractors + 1)
    for layout in layouts("push", BlocksConfig("odd_groups", distractors), 20):
        counts = Counter(names(layout))
        own = names(layout)[layout.target]
        assert counts.pop(own) == 1
        if distractors >= 2:
            assert min(counts.values()) >= 2
            assert len(counts) == distractors // 2


def test_reddest_is_not_always_the_same_place_nor_always_red() -> None:
    drawn = layouts("push", BlocksConfig("reddest", 3))
    assert {x.target for x in drawn} == {0, 1, 2, 3}
    assert len({names(x)[x.target] for x in drawn}) > 2


def test_the_colour_of_the_odd_object_can_be_fixed() -> None:
    fixed = layouts("push", BlocksConfig("odd", 0, colour="mediumblue"), 10)
    assert {names(x)[0] for x in fixed} == {"mediumblue"}
    assert len({names(x)[0] for x in layouts("push", BlocksConfig("odd", 0), 30)}) > 8


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"distractors": 5}, "env.blocks.distractors: got 5, expected 0 to 4"),
        ({"distractors": 3, "distractors_to": 2}, r"env.blocks.distractors_to: got 2, expected 3 \("),
        ({"distractors_to": 7}, "env.blocks.distractors_to: got 7"),
        ({"colour": "pink"}, "env.blocks.colour: got 'pink', expected one of lime"),
        ({"colour": "lime", "task": "red"}, "expected no colour with env.blocks.task=red"),
    ],
)
def test_bad_settings_are_refused(settings: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        BlocksConfig(**settings)
