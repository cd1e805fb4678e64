"""CIEDE2000 against the published test data (Sharma, Wu and Dalal 2005, table 1), and the colours' redness."""

from __future__ import annotations

import numpy as np
import pytest
from ciede2000 import ciede2000, lab, redness

from playslot_rl.config.env import COLOURS
from playslot_rl.envs.block_layout import REDNESS

PAIRS = [
    ((50.0, 2.6772, -79.7751), (50.0, 0.0, -82.7485), 2.0425),
    ((50.0, -1.3802, -84.2814), (50.0, 0.0, -82.7485), 1.0),
    ((50.0, 0.0, 0.0), (50.0, -1.0, 2.0), 2.3669),
    ((50.0, 2.49, -0.001), (50.0, -2.49, 0.0009), 7.1792),
    ((50.0, 2.49, -0.001), (50.0, -2.49, 0.0011), 7.2195),
    ((50.0, -0.001, 2.49), (50.0, 0.0011, -2.49), 4.7461),
    ((50.0, 2.5, 0.0), (73.0, 25.0, -18.0), 27.1492),
    ((50.0, 2.5, 0.0), (58.0, 24.0, 15.0), 19.4535),
    ((60.2574, -34.0099, 36.2677), (60.4626, -34.1751, 39.4387), 1.2644),
    ((22.7233, 20.0904, -46.694), (23.0331, 14.973, -42.5619), 2.0373),
    ((90.8027, -2.0831, 1.441), (91.1528, -1.6435, 0.0447), 1.4441),
    ((6.7747, -0.2908, -2.4247), (5.8714, -0.0985, -2.2286), 0.6377),
    ((2.0776, 0.0795, -1.135), (0.9033, -0.0636, -0.5514), 0.9082),
]


@pytest.mark.parametrize(("first", "second", "expected"), PAIRS)
def test_differences_are_the_published_ones_both_ways(first: tuple, second: tuple, expected: float) -> None:
    a, b = np.array(first), np.array(second)
    assert ciede2000(a, b) == pytest.approx(expected, abs=5e-5)
    assert ciede2000(b, a) == pytest.approx(expected, abs=5e-5)


def test_lab_of_white_black_and_red() -> None:
    np.testing.assert_allclose(lab((255, 255, 255)), (100.0, 0.0, 0.0), atol=0.02)
    np.testing.assert_allclose(lab((0, 0, 0)), 0.0, atol=1e-9)
    np.testing.assert_allclose(lab((255, 0, 0)), (53.24, 80.09, 67.20), atol=0.02)


def test_red_is_reddest_and_no_two_colours_are_equally_red() -> None:
    order = sorted(COLOURS, key=lambda name: redness(COLOURS[name]))
    assert tuple(order) == REDNESS
    assert order[0] == "red"
    assert redness(COLOURS["red"]) == 0.0
    assert order.index("mediumvioletred") < order.index("orange") < order.index("lime")
    assert len({round(redness(c), 6) for c in COLOURS.values()}) == len(COLOURS) == 16
