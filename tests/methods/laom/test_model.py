"""LAOM's mathematics: where gradients go, what follows what, how far ahead it looks, what labels change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from clips import moving_square
from torch import Tensor

from playslot_rl import keys
from playslot_rl.config import StageConfig
from playslot_rl.config.compose import compose
from playslot_rl.data.clips import Clips
from playslot_rl.data.demonstrations import transitions
from playslot_rl.data.neighbours import Ends, pairs_at
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.views import drawn_demonstrations, first_demonstrations
from playslot_rl.methods.cloning import inferred
from playslot_rl.methods.laom.method import LAOMConfig
from playslot_rl.methods.laom.training import LAOMStage, built
from playslot_rl.methods.supervised import LabelledMoves, jittered
from playslot_rl.seeds.draws import StepGenerators, global_seed
from playslot_rl.training.stage import step_loss

CONFIG = LAOMConfig(
    channels=(8, 16), hidden=32, latent_dim=6, offset=3, label_weight=1.0, target_rate=0.25,
    model=StageConfig(steps=4, batch_size=8),
)  # fmt: skip


def stage(own: LAOMConfig = CONFIG, source: EpisodeFrames | None = None, labelled: int = 3) -> LAOMStage:
    source = source or moving_square()
    size = source.frames.shape[1]
    config = compose(["preset=smoke", "env=button_press", "env.action_dim=2"])
    known = LabelledMoves(first_demonstrations(source, labelled), config, torch.device("cpu")) if labelled else None
    with global_seed(0, 0):
        model, target = built(own, size, 2)
    return LAOMStage(model, target, Clips(source, 2, validation=0.2, seed=0, shown=64), known, own)


def test_a_look_ahead_ends_with_the_episode_and_reaches_every_step_before() -> None:
    source = drawn_demonstrations(moving_square(episodes=5, length=6), seed=1)
    ends, moves = Ends.of(source), transitions(source)
    found = {
        int(row): {int(ends.ahead(np.array([row]), 4, np.random.default_rng(n))[0]) for n in range(200)}
        for row in moves.rows
    }
    for row, later in found.items():
        last = row // 6 * 6 + 5
        assert later == set(range(row + 1, min(row + 4, last) + 1))
        assert (ends.past(np.array([row]), 2)[0, 0], ends.first[row]) == (max(row - 1, last - 5), last - 5)


def test_a_batch_is_a_frame_the_next_one_and_one_ahead() -> None:
    source = moving_square()
    numbered = replace(source, frames=np.tile(np.arange(24, dtype=np.uint8)[:, None, None, None], (1, 32, 32, 3)))
    made = stage(source=numbered)
    for step in range(5):
        batch = made.batch(step, StepGenerators(0, step))
        now, after, later = batch[f"videos/{keys.PIXELS}"][:, :, 0, 0, 0].unbind(1)
        assert torch.equal(after, now + 1)
        assert ((later > now) & (later <= now + 3) & (later // 6 == now // 6)).all()
        rows, ahead = batch[f"labelled/{keys.PIXELS}"][:, :, 0, 0, 0].long().unbind(1)
        assert ((rows < 18) & (ahead // 6 == rows // 6)).all(), "of the three labelled demonstrations"
        assert source.actions is not None
        np.testing.assert_array_equal(batch[f"labelled/{keys.ACTION}"], source.actions[rows])


def test_the_target_gets_no_gradient_and_follows_the_encoder() -> None:
    made = stage()
    optimizer = torch.optim.SGD(made.model.parameters(), lr=0.1)
    before = [weights.clone() for weights in made.target.features.parameters()]
    for step in range(2):
        optimizer.zero_grad()
        step_loss(made, step, StepGenerators(0, step))["loss"].backward()
        if step == 0:
            assert all(map(torch.equal, before, made.target.features.parameters())), "nothing to follow yet"
            optimizer.step()
    assert all(weights.grad is None for weights in made.target.parameters())
    moved = [old + 0.25 * (new - old) for old, new in zip(before, made.model.features.parameters(), strict=True)]
    for expected, weights in zip(moved, made.target.features.parameters(), strict=True):
        torch.testing.assert_close(weights, expected)
    assert any(not torch.equal(old, new) for old, new in zip(before, moved, strict=True))
    made.model.eval()
    made.loss(made.batch(2, StepGenerators(0, 2)), 2, StepGenerators(0, 2))
    torch.testing.assert_close(next(made.target.features.parameters()), moved[0])


def test_the_encoder_learns_through_the_latent_action_alone() -> None:
    made = stage()
    with torch.no_grad():
        made.model.forward_model.out.weight.normal_(std=0.1)
    h = made.model.features(torch.rand(4, 3, 32, 32))
    z = torch.randn(4, 6)
    made.model.change(h, z).sum().backward()
    assert all(weights.grad is None for weights in made.model.features.parameters())
    made.model.change(h, made.model.infer(h, h.flip(0))).square().sum().backward()
    assert all(
        bool(weights.grad.abs().sum() > 0) for weights in made.model.features.parameters() if weights.grad is not None
    )
    assert next(made.model.features.parameters()).grad is not None


def test_before_training_the_error_is_that_of_no_change() -> None:
    made = stage(labelled=0)
    assert made.validate(0)["unexplained"] == 1
    with torch.no_grad():
        assert 0.3 < float(step_loss(made, 0, StepGenerators(0, 0))["loss"]) < 3


def test_frames_of_a_transition_are_shifted_alike_and_rows_by_themselves() -> None:
    plain = torch.arange(32 * 32, dtype=torch.float32).view(1, 1, 1, 32, 32).expand(16, 3, 3, 32, 32)
    moved = jittered(plain, 2, StepGenerators(0, 0), "jitter")
    offsets = moved[:, :, 0, 16, 16] - plain[:, :, 0, 16, 16]
    assert {float(offset) for offset in offsets.flatten()} <= {32.0 * y + x for y in range(-2, 3) for x in range(-2, 3)}
    assert (offsets == offsets[:, :1]).all()
    assert len(set(offsets[:, 0].tolist())) > 3
    assert jittered(plain, 0, StepGenerators(0, 0), "jitter") is plain


def distracted(episodes: int, size: int = 16) -> EpisodeFrames:
    """A small square that a known action moves left or right, above a bright bar that jumps as it likes."""
    numbers = np.random.default_rng(5)
    frames = np.full((2 * episodes, size, size, 3), 40, np.uint8)
    actions = np.zeros((2 * episodes, 2), np.float32)
    for row in range(2 * episodes):
        if row % 2 == 0:
            x, y = int(numbers.integers(2, size - 6)), int(numbers.integers(0, 4))
            actions[row, 0] = numbers.choice([-1, 1])
        frames[row, y : y + 4, x : x + 4] = (220, 60, 60)
        at = int(numbers.integers(0, size - 6))
        frames[row, 8:, at : at + 6] = (60, 220, 60)
        x += 2 * int(actions[row, 0])
    return replace(
        moving_square(), frames=frames, actions=actions, starts=np.arange(episodes) * 2,
        lengths=np.full(episodes, 2), seeds=np.arange(episodes),
    )  # fmt: skip


def probed(z: Tensor, actions: Tensor) -> float:
    """R^2 of a linear probe of the actions, fitted on the first half of the rows and read on the second."""
    half, x = len(z) // 2, torch.cat((z, torch.ones(len(z), 1)), dim=1).double()
    gram = x[:half].T @ x[:half] + 1e-3 * torch.eye(x.shape[1])
    read = x[half:] @ torch.linalg.solve(gram, x[:half].T @ actions[:half].double())
    left = actions[half:].double()
    return 1 - float((read - left).square().sum() / (left - left.mean(dim=0)).square().sum())


@pytest.mark.slow
def test_labels_make_the_action_readable_off_the_latents_where_something_else_moves_more() -> None:
    source, found = distracted(300), {}
    moves, labelled, steps = transitions(source), 100, 100
    assert source.actions is not None
    for weight in (0.0, 1.0):
        stage_of = replace(CONFIG.model, batch_size=32)
        own = replace(CONFIG, latent_dim=2, offset=1, label_weight=weight, target_rate=0.05, model=stage_of)
        made = stage(own, source, labelled if weight else 0)
        optimizer = torch.optim.Adam(made.model.parameters(), lr=3e-3)
        for step in range(steps):
            optimizer.param_groups[0]["lr"] = 3e-3 * (1 - step / steps)
            optimizer.zero_grad()
            step_loss(made, step, StepGenerators(0, step))["loss"].backward()
            optimizer.step()
        latents = inferred(made.model.eval(), source.pixels, pairs_at(moves.rows))
        actions = torch.from_numpy(source.actions[moves.rows, :1])
        found[weight] = probed(latents[labelled:], actions[labelled:])
    assert 1 - found[1.0] < 0.4 * (1 - found[0.0])


def test_validation_counts_the_directions_that_the_latents_have() -> None:
    made = stage(labelled=0, source=moving_square(episodes=20))
    assert 1.2 < made.validate(0)["directions"] <= made.config.latent_dim
    with torch.no_grad():  # all numbers of z say the same
        out = made.model.inverse.out
        out.weight.copy_(out.weight[:1].expand_as(out.weight))
    assert made.validate(0)["directions"] == pytest.approx(1, abs=1e-3)
