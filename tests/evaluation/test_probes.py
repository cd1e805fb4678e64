"""Probes and codebook statistics on data whose answer is known."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from playslot_rl.evaluation.probes import code_table, codebook_usage, infer_latents, probe_actions
from playslot_rl.testing import tiny_config
from playslot_rl.world_model import WorldModel


def _data(episodes: int = 24, steps: int = 15) -> tuple[Any, Any, Any]:
    rng = np.random.default_rng(0)
    z = rng.normal(size=(episodes * steps, 5)).astype(np.float32)
    return z, rng, np.repeat(np.arange(episodes), steps)


def test_linear_probe_recovers_a_linear_action_and_nothing_of_noise() -> None:
    z, rng, episodes = _data()
    actions = np.stack([z @ np.arange(1, 6), rng.normal(size=len(z))], 1).astype(np.float32)
    result = probe_actions(z, actions, episodes)
    assert result["linear"]["r2"][0] > 0.99
    assert result["linear"]["r2"][1] < 0.1


def test_nonlinear_probe_sees_what_the_linear_one_cannot() -> None:
    z, _, episodes = _data(60)
    actions = (z[:, :1] * z[:, 1:2]).astype(np.float32)
    result = probe_actions(z, actions, episodes)
    assert result["linear"]["mean_r2"] < 0.2
    assert result["mlp"]["mean_r2"] > 0.6


def test_whole_episodes_are_held_out_and_the_probe_repeats() -> None:
    z, _, episodes = _data()
    # The action is the episode's number: a probe that had seen the held-out episodes could look it up.
    names = np.random.default_rng(3).normal(size=24)
    keyed = np.concatenate([z, np.eye(24, dtype=np.float32)[episodes]], 1)
    actions = names[episodes][:, None].astype(np.float32)
    result = probe_actions(keyed, actions, episodes)
    assert result["linear"]["mean_r2"] < 0.2
    assert result["train"] + result["test"] == len(z)
    assert result["test_episodes"] == 6
    assert result == probe_actions(keyed, actions, episodes)


def test_an_action_that_never_varies_has_no_score() -> None:
    z, _, episodes = _data()
    actions = np.stack([z[:, 0], np.zeros(len(z))], 1).astype(np.float32)
    score = probe_actions(z, actions, episodes)["linear"]
    assert score["r2"][1] is None
    assert score["mean_r2"] == score["r2"][0]


def test_a_gripper_that_only_trembles_in_the_tested_episodes_has_no_score() -> None:
    z, rng, episodes = _data()
    tested = episodes >= 18
    closes = (rng.random(len(z)) < 0.1).astype(np.float32)
    gripper = np.where(tested, 0.002 * rng.normal(size=len(z)), closes)
    score = probe_actions(z, np.stack([z[:, 0], gripper], 1).astype(np.float32), episodes, tested=tested)["linear"]
    assert score["r2"][1] is None
    assert score["mean_r2"] == score["r2"][0] > 0.99


def test_code_probe_sees_the_code_only() -> None:
    z, rng, episodes = _data(120)
    codes = rng.integers(0, 3, (len(z), 1))
    actions = (codes * 1.0 + z[:, :1]).astype(np.float32)
    score = probe_actions(z, actions, episodes, codes=codes)["code"]["mean_r2"]
    assert score == pytest.approx(0.4, abs=0.1)  # variance of the code is 2/3, that of z is 1


def test_probe_refuses_a_single_episode() -> None:
    with pytest.raises(ValueError, match="at least 2"):
        probe_actions(np.zeros((5, 2), np.float32), np.zeros((5, 1), np.float32), np.zeros(5, np.int64))


def test_perplexity_counts_the_codes_in_equal_use() -> None:
    assert codebook_usage(np.arange(40) % 4, 8) == {
        "counts": [10, 10, 10, 10, 0, 0, 0, 0],
        "used": 4,
        "perplexity": pytest.approx(4.0),
    }
    assert codebook_usage(np.zeros(5, np.int64), 8)["perplexity"] == pytest.approx(1.0)
    with pytest.raises(ValueError, match="codebook_usage: got"):
        codebook_usage(np.array([8]), 8)


def test_code_table_gives_the_mean_action_of_each_code() -> None:
    rows = code_table(np.array([0, 0, 2]), np.array([[0.0], [1.0], [-1.0]], np.float32), 3)
    assert [row["count"] for row in rows] == [2, 0, 1]
    assert rows[0]["mean"] == [0.5]
    assert rows[1]["mean"] is None
    assert rows[2]["std"] == [0.0]


@pytest.mark.parametrize("multi", [False, True])
def test_latents_of_whole_episodes_do_not_cross_their_borders(multi: bool) -> None:
    config = tiny_config(multi=multi)
    model = WorldModel(config.model, config.env).inverse_dynamics
    model.train()(torch.randn(4, 9, 4, 32))  # fills the codebook
    model.eval()
    slots = torch.randn(9, 4, 32).numpy()
    z, codes, episodes = infer_latents(model, slots, [0, 5], [5, 4])
    assert z.shape == (7, 32 if multi else 8)
    assert codes.shape == (7, 4 if multi else 1)
    assert episodes.tolist() == [0] * 4 + [1] * 3
    alone, _, _ = infer_latents(model, slots[5:], [0], [4])
    np.testing.assert_allclose(z[4:], alone, atol=1e-6)
