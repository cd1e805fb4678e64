"""CADDY at test: what a prediction may look at, that it is fed back, and that it repeats. S is 2, T is 5."""

from __future__ import annotations

import pytest
import torch
from caddy_parts import clips, tiny

from playslot_rl.methods.caddy.model import CADDY

S, T = 2, 5


def test_a_prediction_repeats_and_draws_nothing(model: CADDY) -> None:
    before = torch.get_rng_state()
    first = model.predict(clips(), S)
    assert torch.equal(torch.get_rng_state(), before)
    assert torch.equal(model.predict(clips(), S), first)
    assert first.shape == (3, T - S, 3, 16, 16)
    assert ((first > 0) & (first < 1)).all()


def test_a_prediction_is_made_in_evaluation_mode_and_the_mode_stays(model: CADDY) -> None:
    expected, state = model.predict(clips(), S), {k: v.clone() for k, v in model.state_dict().items()}
    assert torch.equal(model.train().predict(clips(), S), expected)
    assert model.training
    assert all(torch.equal(value, state[key]) for key, value in model.state_dict().items())


def test_a_clips_prediction_does_not_depend_on_its_batch(model: CADDY) -> None:
    torch.testing.assert_close(model.predict(clips()[1:2], S), model.predict(clips(), S)[1:2], atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("changed", [2, 3, 4])
def test_a_changed_true_frame_changes_no_prediction_of_an_earlier_time(model: CADDY, changed: int) -> None:
    """Frame t steers through the moves into it and out of it: x^_t and what comes after it, nothing before."""
    frames, other = clips(), clips()
    other[:, changed] = clips(seed=1)[:, 0]
    first, second = model.predict(frames, S), model.predict(other, S)
    assert torch.equal(first[:, : changed - S], second[:, : changed - S])
    assert not torch.equal(first[:, changed - S], second[:, changed - S])


def test_with_donors_the_own_future_has_no_effect_and_theirs_has(model: CADDY) -> None:
    frames, other, donors = clips(), clips(), clips(seed=2)
    other[:, S:] = clips(seed=1)[:, S:]
    first = model.predict(frames, S, donors)
    assert torch.equal(model.predict(other, S, donors), first)
    changed = donors.clone()
    changed[:, -1] = clips(seed=3)[:, -1]
    assert not torch.equal(model.predict(frames, S, changed), first)
    assert not torch.equal(model.predict(frames, S), first)


def test_with_donors_their_frames_before_the_last_of_the_seed_have_no_effect(model: CADDY) -> None:
    frames, donors = clips(), clips(seed=2)
    other = donors.clone()
    other[:, : S - 1] = clips(seed=3)[:, : S - 1]
    assert torch.equal(model.predict(frames, S, other), model.predict(frames, S, donors))


def test_a_clip_is_its_own_donor(model: CADDY) -> None:
    assert torch.equal(model.predict(clips(), S, clips()), model.predict(clips(), S))


def test_without_variability_only_the_indices_of_the_actions_matter() -> None:
    model = tiny(variability="zero").eval()
    frames, donors = clips(), clips(seed=2)
    latents = model.infer(donors[:, S - 1 :])
    within = model.infer(frames[:, :S])
    index = torch.cat((within.p, latents.p), dim=1).argmax(dim=-1)
    only = type(latents)(torch.nn.functional.one_hot(index, 3).float(), torch.zeros(3, T - 1, 2), latents.p)
    assert torch.equal(model.predict(frames, S, donors), model.rollout(frames[:, :S], only))
    with torch.no_grad():
        model.action.centroids.add_(1)
    assert torch.equal(model.predict(frames, S, donors), model.rollout(frames[:, :S], only))
    assert len(index.unique()) > 1, "else no action would have been told from another"


def test_with_variability_more_than_the_indices_matters(model: CADDY) -> None:
    inferred = model.predict(clips(), S)
    model.variability = "zero"
    assert not torch.equal(model.predict(clips(), S), inferred)


def test_past_the_seed_each_frame_is_predicted_from_the_one_before() -> None:
    model = tiny().eval()
    frames = clips()
    latents = model.infer(frames)
    memories, given, expected = model.dynamics.begin(3), frames[:, 0], []
    for t in range(T - 1):
        s, _ = model.encoder(given * 2 - 1)
        y, memories = model.dynamics(s, latents.a[:, t], latents.v[:, t], memories)
        predicted = (model.generator(y)[-1] + 1) / 2
        given = frames[:, t + 1] if t + 1 < S else predicted
        expected.append(predicted)
    torch.testing.assert_close(model.predict(frames, S), torch.stack(expected[S - 1 :], dim=1), atol=1e-5, rtol=1e-4)


def test_one_seed_frame_does(model: CADDY) -> None:
    assert model.predict(clips(), 1).shape == (3, T - 1, 3, 16, 16)


def test_bytes_and_numbers_predict_the_same(model: CADDY) -> None:
    pixels = torch.randint(256, (2, T, 3, 16, 16), dtype=torch.uint8)
    assert torch.equal(model.predict(pixels, S), model.predict(pixels.float() / 255, S))


def test_wrong_clips_are_refused(model: CADDY) -> None:
    with pytest.raises(ValueError, match="got 5 frames with 5 seed frames"):
        model.predict(clips(), 5)
    with pytest.raises(ValueError, match=r"donors: got \(2, 5, 3, 16, 16\), expected \(3, 5"):
        model.predict(clips(), S, clips(2))
    with pytest.raises(ValueError, match=r"frames: got shape \(3, 5, 3, 32, 32\)"):
        model.predict(clips(size=32), S)
    with pytest.raises(ValueError, match="got 1 moves, expected at least 2"):
        model.rollout(clips()[:, :2], model.infer(clips()[:, :2]))
    with pytest.raises(ValueError, match="got 1 frames"):
        model(clips(frames=1), S, 1.0, torch.Generator())
    with pytest.raises(ValueError, match=r"\[5\] wanted"):
        model(clips(), S, 1.0, torch.Generator(), wanted=[5])
