"""What SVG sees at which moment: skips, latents, its own predictions."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn

from playslot_rl.methods.svg.model import SVG

SEED = 3


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def other(frames: Tensor, *at: int) -> Tensor:
    """The clips with other frames at some places."""
    changed = frames.clone()
    changed[:, list(at)] = torch.rand(changed[:, list(at)].shape, generator=generator(9))
    return changed


def changed_frames(one: Tensor, two: Tensor) -> list[bool]:
    """Which frames (B, M, 3, H, W) differ."""
    return [not torch.equal(one[:, i], two[:, i]) for i in range(one.shape[1])]


@pytest.fixture
def still(model: SVG) -> SVG:
    """A model whose decoder is always given the same code: what it draws depends on the skip maps alone."""
    nn.init.zeros_(model.predictor.to_code.weight)
    return model


def test_at_test_the_skips_come_from_the_last_seed_frame_only(still: SVG, frames: Tensor) -> None:
    predicted = still.predict(frames, SEED)
    assert changed_frames(predicted, still.predict(other(frames, 3, 4, 5), SEED)) == [False] * 3
    assert changed_frames(predicted, still.predict(other(frames, 0, 1), SEED)) == [False] * 3
    assert changed_frames(predicted, still.predict(other(frames, 2), SEED)) == [True] * 3
    assert changed_frames(predicted, still.sample(frames, SEED, generator())) == [False] * 3


@pytest.mark.parametrize(
    ("at", "expected"),
    [
        (0, [True, False, False, False, False]),
        (1, [False, True, False, False, False]),
        (2, [False, False, True, True, True]),
        (3, [False] * 5),
        (5, [False] * 5),
    ],
)
def test_in_training_the_skips_come_from_the_frame_before_and_past_the_seed_from_its_last(
    still: SVG, frames: Tensor, at: int, expected: list[bool]
) -> None:
    before = still(frames, SEED, generator()).predicted
    assert changed_frames(before, still(other(frames, at), SEED, generator()).predicted) == expected


def test_a_frame_past_the_seed_enters_through_the_latents_alone(model: SVG, frames: Tensor) -> None:
    predicted = model.predict(frames, SEED)
    assert changed_frames(predicted, model.predict(other(frames, 4), SEED)) == [False, True, True]
    nn.init.zeros_(model.posterior.to_mean.weight)
    assert torch.equal(model.predict(frames, SEED), model.predict(other(frames, 3, 4, 5), SEED))


def test_with_donors_the_own_future_has_no_effect_and_theirs_has(model: SVG, frames: Tensor) -> None:
    donors = frames.flip(0)
    predicted = model.predict(frames, SEED, donors)
    assert torch.equal(predicted, model.predict(other(frames, 3, 4, 5), SEED, donors))
    assert changed_frames(predicted, model.predict(frames, SEED, other(donors, 4))) == [False, True, True]
    assert not torch.equal(predicted, model.predict(frames, SEED))


def test_a_clip_that_is_its_own_donor_is_predicted_as_without_one(model: SVG, frames: Tensor) -> None:
    torch.testing.assert_close(model.predict(frames, SEED, frames), model.predict(frames, SEED))


def test_donors_of_another_shape_are_refused(model: SVG, frames: Tensor) -> None:
    with pytest.raises(ValueError, match="donors: got"):
        model.predict(frames, SEED, frames[:, :4])


def test_a_sample_depends_on_no_frame_past_the_seed(model: SVG, frames: Tensor) -> None:
    sampled = model.sample(frames, SEED, generator())
    assert torch.equal(sampled, model.sample(other(frames, 3, 4, 5), SEED, generator()))
    for at in range(SEED):
        assert not torch.equal(sampled, model.sample(other(frames, at), SEED, generator()))


def test_a_sample_is_drawn_from_the_learned_prior(model: SVG, frames: Tensor) -> None:
    sampled = model.sample(frames, SEED, generator())
    assert changed_frames(sampled, model.sample(frames, SEED, generator(1))) == [True] * 3
    nn.init.constant_(model.prior.to_log_variance.bias, -200.0)
    certain = model.sample(frames, SEED, generator())
    torch.testing.assert_close(certain, model.sample(frames, SEED, generator(1)))
    nn.init.constant_(model.prior.to_mean.bias, 3.0)
    assert changed_frames(certain, model.sample(frames, SEED, generator())) == [True] * 3


class Spoil:
    """Wraps the decoder and replaces the prediction of one call."""

    def __init__(self, model: SVG, call: int) -> None:
        self.calls, self.at = 0, call
        model.decoder.register_forward_hook(self)

    def __call__(self, module: nn.Module, inputs: Any, output: Tensor) -> Tensor | None:
        self.calls += 1
        return 1 - output if self.calls == self.at + 1 else None


@pytest.mark.parametrize("inferred", [True, False], ids=["predict", "sample"])
def test_a_wrong_prediction_influences_the_next_ones(model: SVG, frames: Tensor, inferred: bool) -> None:
    def predict() -> Tensor:
        return model.predict(frames, SEED) if inferred else model.sample(frames, SEED, generator())

    right = predict()
    Spoil(model, 1)
    assert changed_frames(right, predict()) == [False, True, True]


def test_in_training_latents_are_sampled_and_at_test_they_are_means(model: SVG, frames: Tensor) -> None:
    one, two = (model(frames, SEED, generator(seed)).predicted for seed in (0, 1))
    assert changed_frames(one, two) == [True] * 5
    predicted = model.predict(frames, SEED)
    nn.init.constant_(model.posterior.to_log_variance.bias, -200.0)
    assert torch.equal(model.predict(frames, SEED), predicted)


def test_in_training_nothing_is_fed_back(model: SVG, frames: Tensor) -> None:
    right = model(frames, SEED, generator()).predicted
    model.decoder.register_forward_hook(lambda module, inputs, output: torch.cat((1 - output[:1], output[1:])))
    wrong = model(frames, SEED, generator()).predicted
    assert changed_frames(right[:1], wrong[:1]) == [True, False, False, False, False]


def test_the_first_prediction_is_the_teacher_forced_one_where_the_posterior_is_certain(
    model: SVG, frames: Tensor
) -> None:
    nn.init.constant_(model.posterior.to_log_variance.bias, -200.0)
    teacher, own = model(frames, SEED, generator()).predicted[:, SEED - 1 :], model.predict(frames, SEED)
    torch.testing.assert_close(own[:, 0], teacher[:, 0])
    assert not torch.allclose(own[:, 1], teacher[:, 1])


def test_a_prior_never_sees_the_frame_it_foresees_and_a_posterior_does(model: SVG, frames: Tensor) -> None:
    one, two = (model(clip, SEED, generator()) for clip in (frames, other(frames, 3)))
    same = [
        [torch.equal(a[:, i], b[:, i]) for i in range(5)]
        for a, b in zip((*one.posterior, *one.prior), (*two.posterior, *two.prior), strict=True)
    ]
    assert same[:2] == [[True, True, False, False, False]] * 2
    assert same[2:] == [[True, True, True, False, False]] * 2


def test_chosen_steps_are_decoded_as_when_all_are(model: SVG, frames: Tensor) -> None:
    every = model(frames, SEED, generator()).predicted
    steps = torch.tensor([[4, 0], [1, 2]])
    some = model(frames, SEED, generator(), steps)
    assert torch.equal(some.steps, steps)
    for clip in range(2):
        torch.testing.assert_close(some.predicted[clip], every[clip, steps[clip]])


def test_one_seed_frame_is_enough_and_bytes_are_taken(model: SVG) -> None:
    pixels = torch.randint(256, (2, 4, 3, 16, 16), dtype=torch.uint8, generator=generator())
    assert model.predict(pixels, 1).shape == (2, 3, 3, 16, 16)
    assert model.sample(pixels, 1, generator()).shape == (2, 3, 3, 16, 16)
    torch.testing.assert_close(model.predict(pixels, 2), model.predict(pixels / 255, 2))


@pytest.mark.parametrize("seed", [0, 6, 7])
def test_a_clip_without_a_frame_past_the_seed_is_refused(model: SVG, frames: Tensor, seed: int) -> None:
    for call in (
        lambda: model.predict(frames, seed),
        lambda: model.sample(frames, seed, generator()),
        lambda: model(frames, seed, generator()),
    ):
        with pytest.raises(ValueError, match="clip: got 6 frames"):
            call()
