"""Episodes of different uses have different numbers, whatever seeds people type."""

from __future__ import annotations

import itertools
import json
import random
from typing import get_args

import numpy as np
import pytest

from playslot_rl.config import CompareConfig, EnvConfig, EvaluationConfig, ExperimentConfig, RenderConfig
from playslot_rl.seeds.episodes import EPISODES, LARGEST_SEED, Stream, episode_seed, redraw_stride

STREAMS: tuple[Stream, ...] = get_args(Stream)
EDGES = (0, 1, 999, 1000, 1001, 1899, 1900, 1901, 2000, 4242, 2**31, LARGEST_SEED, LARGEST_SEED + 1)
DRAWS = 20


def numbers(stream: Stream, seed: int, index: int, turns: int = 1) -> list[int]:
    """An episode's number and those it is redrawn with."""
    first = episode_seed(stream, seed, index)
    return [first + attempt * redraw_stride(first, turns) for attempt in range(DRAWS)]


@pytest.mark.parametrize("turns", [1, 5, 10])
def test_no_number_has_two_episodes_and_redrawn_ones_keep_their_turn(turns: int) -> None:
    rng = random.Random(0)
    drawn = {rng.randint(0, rng.choice([1200, 10**6, LARGEST_SEED])) for _ in range(100)}
    seen: dict[int, tuple[Stream, int, int, int]] = {}
    for stream, seed in itertools.product(STREAMS, sorted({*EDGES, *drawn})):
        for index in {0, 1, 499_999, 500_000, EPISODES - 1, *(rng.randrange(EPISODES) for _ in range(5))}:
            for attempt, number in enumerate(numbers(stream, seed, index, turns)):
                assert 0 <= number < 2**62
                assert number % turns == episode_seed(stream, seed, index) % turns
                assert seen.setdefault(number, (stream, seed, index, attempt)) == (stream, seed, index, attempt)


def test_streams_are_apart_as_intervals_and_not_only_where_we_looked() -> None:
    """Small seeds fill disjoint intervals below every redraw; of the others the highest bits are the stream."""
    ends = []
    for stream in STREAMS:
        small = [s for s in range(2100) if episode_seed(stream, s, 0) < 2**45]
        assert small == list(range(len(small)))
        assert len(small) >= 1000
        ends.append((episode_seed(stream, 0, 0), episode_seed(stream, len(small) - 1, EPISODES - 1)))
        large = episode_seed(stream, len(small), 0), episode_seed(stream, LARGEST_SEED + 1, EPISODES - 1)
        bits = {(number + attempt * redraw_stride(number)) >> 59 for number in large for attempt in (0, DRAWS - 1)}
        assert bits == {1 + STREAMS.index(stream)}
    assert all(one[1] < other[0] for one, other in itertools.pairwise(ends))
    assert ends[-1][1] < redraw_stride(0)
    assert ends[-1][1] + 31 * redraw_stride(0) < 2**45


@pytest.mark.parametrize("seed", [0, 1, 7, 100, 999])
def test_small_seeds_keep_the_numbers_they_always_had(seed: int) -> None:
    assert episode_seed("collection", seed, 500_003) == seed * 10**6 + 500_003
    assert episode_seed("evaluation", seed, 3) == 10**9 + seed * 10**6 + 3
    assert episode_seed("training", seed, 3) == 3 * 10**9 + seed * 10**6 + 3
    assert redraw_stride(episode_seed("training", seed, 3)) == 10**12
    assert episode_seed("development", 0, 3) == 4 * 10**9 + 3


@pytest.mark.parametrize("offset", [0, 7, EvaluationConfig().seed_offset, 2 * EvaluationConfig().seed_offset])
@pytest.mark.parametrize("seed", EDGES)
def test_evaluation_never_reaches_training_wherever_it_starts(offset: int, seed: int) -> None:
    first = episode_seed("evaluation", seed, 0, offset)
    last = first + EPISODES + DRAWS * EPISODES  # evaluation redraws by the number of its episodes
    assert last < episode_seed("training", 0, 0) or first >> 59 == last >> 59 == 1 + STREAMS.index("evaluation")


@pytest.mark.parametrize(("seed", "index"), [(-1, 0), (2**34, 0), (0, -1), (0, EPISODES)])
def test_what_has_no_number_is_refused(seed: int, index: int) -> None:
    with pytest.raises(ValueError, match=r"got .*, expected 0 to"):
        episode_seed("collection", seed, index)


@pytest.mark.parametrize("seed", [-1, LARGEST_SEED + 1])
def test_seeds_have_32_bits(seed: int) -> None:
    assert ExperimentConfig(seed=LARGEST_SEED).seed == LARGEST_SEED
    expected = f"got {seed}, expected a non-negative integer of 32 bits"
    with pytest.raises(ValueError, match=f"seed: {expected}"):
        ExperimentConfig(seed=seed)
    with pytest.raises(ValueError, match=f"seeds: {expected}"):
        CompareConfig(seeds=(0, seed))
    with pytest.raises(ValueError, match=f"evaluation_seed: {expected}"):
        CompareConfig(evaluation_seed=seed)


def test_json_and_int64_keep_the_largest_number() -> None:
    largest = numbers("development", LARGEST_SEED + 1, EPISODES - 1)[-1]
    assert json.loads(json.dumps(largest)) == largest
    assert int(np.array([largest], np.int64)[0]) == largest


@pytest.mark.parametrize("name", ["button_press", "block_reach"])
def test_a_task_takes_the_largest_number(name: str) -> None:
    from playslot_rl.envs import make_env

    warmup = 0 if name == "block_reach" else 1
    env = make_env(EnvConfig(name, image_size=32, warmup_steps=warmup), RenderConfig(supersample=1))
    try:
        number = numbers("development", LARGEST_SEED, EPISODES - 1)[-1]
        first, again, other = (env.reset(seed=s)[0]["pixels"] for s in (number, number, number - 1))
        assert (first == again).all()
        assert (first != other).any()
    finally:
        env.close()
