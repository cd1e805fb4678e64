"""Prototypes that do the same are found, and said."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from playslot_rl.play.session import PlaySession
from playslot_rl.play.steering import alike, in_words


def moved(*places: int, noise: float = 0.0) -> npt.NDArray[np.uint8]:
    """What prototypes show that move a square to these columns in four frames."""
    frames = np.full((len(places), 4, 32, 32, 3), 90.0)
    for number, place in enumerate(places):
        for step in range(4):
            x = 12 + (place - 12) * (step + 1) // 4
            frames[number, step, 12:20, x : x + 8] = 250
    frames += np.random.default_rng(0).normal(0, noise, frames.shape)
    return np.clip(frames, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("noise", [0.0, 6.0])
def test_those_that_end_alike_on_the_same_way_do_the_same(noise: float) -> None:
    assert alike(moved(2, 22, 12, 22, 2, noise=noise)) == {3: 1, 4: 0}
    assert alike(moved(2, 22, 12, 7, 17, noise=noise)) == {}


def test_what_counts_as_the_same_depends_on_how_far_the_others_are_apart() -> None:
    shades = np.array([100, 104, 20, 220], np.uint8)
    frames = np.broadcast_to(shades[:, None, None, None, None], (4, 2, 8, 8, 3))
    assert alike(frames[:2]) == {}
    assert alike(frames) == {1: 0}


def test_all_are_the_same_where_none_does_anything() -> None:
    still = moved(12, 12, 12)
    still[1] += 1  # nobody sees it
    assert alike(still[:1]) == {}
    assert alike(moved(12, 12, 12)) == {1: 0, 2: 0}
    barely = moved(12, 12)
    barely[1, :, 0, 0] += 1
    assert alike(barely) == {1: 0}


def test_a_prototype_twice_in_a_codebook_is_found(session: PlaySession) -> None:
    assert alike(session.preview()[:, 1:]).get(3) is None
    session.prototypes = session.prototypes.clone()
    session.prototypes[3] = session.prototypes[1]
    assert alike(session.preview()[:, 1:])[3] == 1


def test_it_is_said_in_one_line() -> None:
    assert in_words({}) == ""
    assert in_words({3: 1}) == "from here, 3 does the same as 1"
    assert in_words({3: 1, 5: 2, 6: 2}) == "from here, 3 does the same as 1; 5 and 6 do the same as 2"
    assert in_words({4: 0, 5: 0, 7: 0}) == "from here, 4, 5 and 7 do the same as 0"
