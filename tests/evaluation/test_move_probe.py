"""The probe finds what a latent says about a move, and nothing where nothing is said."""

from __future__ import annotations

import numpy as np
import pytest

from playslot_rl.evaluation.probes import probe_moves

CLIPS = np.repeat(np.arange(40), 25)
MOVES = np.random.default_rng(0).integers(5, size=len(CLIPS))


def test_prototypes_that_name_the_move_are_read_without_error() -> None:
    codebook = np.random.default_rng(1).normal(size=(5, 8)).astype(np.float32)
    found = probe_moves(codebook[MOVES], MOVES, CLIPS, 5)
    assert found["accuracy"] == 1.0
    assert found["chance"] == 0.2
    assert found["test_clips"] == 12
    assert found["train"] + found["test"] == len(MOVES)


def test_random_latents_are_no_better_than_the_most_frequent_move() -> None:
    noise = np.random.default_rng(2).normal(size=(len(MOVES), 8)).astype(np.float32)
    found = probe_moves(noise, MOVES, CLIPS, 5)
    assert found["accuracy"] < 0.3


def test_two_moves_under_one_prototype_cost_what_they_should() -> None:
    merged = np.array([0, 1, 2, 3, 3])
    found = probe_moves(np.eye(4, dtype=np.float32)[merged[MOVES]], MOVES, CLIPS, 5)
    assert 0.7 < found["accuracy"] < 0.9


def test_one_prototype_for_all_reads_the_most_frequent_move() -> None:
    skewed = np.where(np.random.default_rng(3).random(len(MOVES)) < 0.5, 4, MOVES)
    found = probe_moves(np.ones((len(MOVES), 8), np.float32), skewed, CLIPS, 5)
    assert found["accuracy"] == found["majority"] > 0.5


def test_what_is_memorised_of_a_clip_does_not_count() -> None:
    name = np.eye(40, dtype=np.float32)[CLIPS]  # says which clip it is: worthless on other clips
    own = np.random.default_rng(4).integers(5, size=40)[CLIPS]
    assert probe_moves(name, own, CLIPS, 5)["accuracy"] < 0.6


def test_a_single_move_and_wrong_sizes() -> None:
    same = np.zeros_like(MOVES)
    assert probe_moves(np.ones((len(MOVES), 2), np.float32), same, CLIPS, 5)["accuracy"] == 1.0
    with pytest.raises(ValueError, match="rows, expected as many each"):
        probe_moves(np.ones((3, 2), np.float32), MOVES, CLIPS, 5)
    with pytest.raises(ValueError, match="got 1 clip"):
        probe_moves(np.ones((3, 2), np.float32), MOVES[:3], np.zeros(3, np.int64), 5)
