"""The report card: held-out episodes, lines on latents whose content is known, and repeatable numbers."""

from __future__ import annotations

import copy
import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from squares import EPISODES, LENGTH, videos

from playslot_rl.config import DataConfig
from playslot_rl.data.clips import Clips
from playslot_rl.data.demonstrations import split_demonstrations
from playslot_rl.data.windows import split_episodes
from playslot_rl.errors import DataError
from playslot_rl.evaluation.card import Card, make_card
from playslot_rl.evaluation.card_lines import ACTIONS, EFFECTS, MEASURES, Line
from playslot_rl.evaluation.held_out import hold_out
from playslot_rl.evaluation.latent_lines import action_lines
from playslot_rl.evaluation.probes import participation_ratio, probe_actions, repaired
from playslot_rl.testing import tiny_agent, tiny_config
from playslot_rl.world_model import WorldModel


@pytest.fixture(scope="module")
def model() -> WorldModel:
    return tiny_agent().world_model


@pytest.fixture(scope="module")
def card(model: WorldModel) -> Card:
    return make_card(model, videos(), {}, DataConfig())


def by_key(lines: list[Line]) -> dict[str, Line]:
    return {one.key: one for one in lines}


@pytest.mark.integration
def test_every_line_says_what_is_good_and_what_is_bad_and_json_holds_it(card: Card) -> None:
    assert [one.key for one in card.lines] == list(MEASURES)
    assert all(one.good and one.bad and one.measure and one.note for one in card.lines)
    assert json.loads(json.dumps([one.plain() for one in card.lines], allow_nan=False))
    assert {one.verdict for one in card.lines} <= {"good", "fair", "bad", "not measured"}
    assert all((one.value is None) == (one.verdict == "not measured") for one in card.lines)


def test_a_card_repeats_to_the_last_bit_and_leaves_the_global_generator_alone(model: WorldModel, card: Card) -> None:
    import torch

    state = torch.get_rng_state()
    again = make_card(model, videos(), {}, DataConfig())
    assert torch.equal(state, torch.get_rng_state())
    assert again.lines == card.lines
    assert again.details == card.details


def test_latents_that_are_the_action_are_recovered_and_wrong_pairs_are_not(model: WorldModel, card: Card) -> None:
    parsed = card.parsed
    assert parsed.actions is not None
    mixed = parsed.actions @ np.random.default_rng(0).normal(size=(4, 8)).astype(np.float32)
    lines = by_key(action_lines(model, replace(parsed, latents=mixed), 0)[0])
    assert lines["linear_probe"].value == pytest.approx(1.0, abs=0.02)
    assert lines["linear_probe"].verdict == "good"
    assert lines["shuffled_probe"].value is not None
    assert lines["shuffled_probe"].value < 0.1
    assert lines["above_frame"].verdict == "good"


@pytest.mark.integration
def test_a_robot_that_follows_late_shows_its_action_in_the_next_latent(model: WorldModel, card: Card) -> None:
    parsed = card.parsed
    assert parsed.actions is not None
    mixed = parsed.actions @ np.random.default_rng(0).normal(size=(4, 8)).astype(np.float32)
    lag = {
        name: by_key(action_lines(model, replace(parsed, latents=latents), 0)[0])["lag"]
        for name, latents in (("at once", mixed), ("late", np.roll(mixed, 1, axis=0)))
    }
    assert lag["at once"].verdict == "good"
    assert lag["late"].verdict == "bad"
    assert lag["late"].value is not None
    assert lag["late"].value > 0.9


def test_the_lag_compares_latents_on_the_same_transitions(model: WorldModel, card: Card) -> None:
    """Actions held for a whole episode but its last transition, which no later latent could show."""
    parsed = card.parsed
    assert parsed.actions is not None
    first = np.searchsorted(parsed.episodes, parsed.episodes)
    held, last = parsed.actions[first], np.diff(parsed.rows, append=-9) != 1
    latents = held @ np.random.default_rng(0).normal(size=(4, 8)).astype(np.float32)
    some = replace(parsed, latents=latents, actions=np.where(last[:, None], -held, held))
    found = by_key(action_lines(model, some, 0)[0])
    assert found["lag"].value == pytest.approx(0, abs=0.02)
    assert found["linear_probe"].value is not None
    assert found["linear_probe"].value < 0.9


def test_latents_of_noise_recover_nothing(model: WorldModel, card: Card) -> None:
    noise = np.random.default_rng(1).normal(size=card.parsed.latents.shape).astype(np.float32)
    lines = by_key(action_lines(model, replace(card.parsed, latents=noise), 0)[0])
    assert lines["linear_probe"].verdict == lines["mlp_probe"].verdict == "bad"
    assert lines["above_frame"].verdict != "good"


@pytest.mark.parametrize(
    ("chosen", "verdict", "share"), [((), "bad", 0.04), ((1, 2), "good", 1.0), ((2, 3), "bad", 0.02)]
)
def test_a_slot_that_moves_by_itself_is_told_from_those_that_the_robot_moves(
    model: WorldModel, card: Card, chosen: tuple[int, ...], verdict: str, share: float
) -> None:
    parsed, generator = card.parsed, np.random.default_rng(0)
    assert parsed.actions is not None
    frames, n, width = parsed.slots.shape
    moved = parsed.actions @ generator.normal(size=(4, width)).astype(np.float32)
    change = np.stack([moved, moved[:, ::-1], 7 * generator.normal(size=moved.shape) * moved.std()], 1)
    change = np.append(change, np.zeros((len(change), n - 3, width)), 1)
    slots = np.zeros((frames, n, width))
    for row, by in zip(parsed.rows, change, strict=True):  # an episode's first frame has slots of zero
        slots[row + 1] = slots[row] + by
    own = copy.deepcopy(model)
    own.inverse_dynamics.config = replace(own.inverse_dynamics.config, slots=chosen)
    found, details = action_lines(own, replace(parsed, slots=slots.astype(np.float32)), 0)
    line = by_key(found)["telling_slots"]
    assert line.verdict == verdict
    assert line.value == pytest.approx(share, abs=0.01)
    assert ("model.inverse_dynamics.slots=[1,2] leaves out" in line.note) == (chosen == ())
    assert ("model.policy.slots=[1,2,4] those that move most" in line.note) == (verdict == "bad")
    assert [round(one["r2"]) for one in details["telling_slots"]] == [1, 1, *[0] * (n - 2)]
    assert sum(one["change"] for one in details["telling_slots"]) == pytest.approx(1)


def test_actions_that_are_no_numbers_are_counted(model: WorldModel, card: Card) -> None:
    parsed, source = card.parsed, card.parsed.source
    assert source.actions is not None
    broken = source.actions.copy()
    broken[parsed.pixels[[2, 5]], 0] = np.nan
    for actions, why in (
        (broken, f"NaN or infinite actions in 2 of {len(parsed.rows)} transitions"),
        (None, "no actions"),
    ):
        given = replace(parsed, source=replace(source, actions=actions), actions=None)
        assert by_key(action_lines(model, given, 0)[0])["linear_probe"].note == why


def test_probes_refuse_an_episode_on_both_sides() -> None:
    z, episodes = np.zeros((6, 2), np.float32), np.repeat(np.arange(2), 3)
    for tested in (np.array([1, 0, 0, 0, 0, 0], bool), np.ones(6, bool), np.zeros(6, bool)):
        with pytest.raises(ValueError, match="two sets of whole episodes"):
            probe_actions(z, z, episodes, tested=tested)


def test_wrong_pairs_stay_on_their_side() -> None:
    sides = np.arange(100) < 30
    order = repaired(np.arange(100), sides, 5)
    assert sorted(order) == list(range(100))
    assert (np.isin(order[sides], np.arange(30))).all()
    assert (order != np.arange(100)).mean() > 0.9


def test_participation_ratio_counts_directions_of_equal_variance() -> None:
    axes = np.concatenate([np.eye(6), -np.eye(6)]).astype(np.float32)
    assert participation_ratio(axes) == pytest.approx(6.0)
    assert participation_ratio(axes * np.array([1, 1, 0, 0, 0, 0], np.float32)) == pytest.approx(2.0)
    assert participation_ratio(axes * np.array([3, 0, 0, 0, 0, 0], np.float32) + 7) == pytest.approx(1.0)
    weights = np.array([2.0, 1.0, 0, 0, 0, 0], np.float32)  # variances 4 and 1: 25 / 17
    assert participation_ratio(axes * weights) == pytest.approx(25 / 17)
    assert participation_ratio(np.ones((5, 3), np.float32)) is None


def test_without_actions_their_lines_are_not_measured(model: WorldModel) -> None:
    found = by_key(make_card(model, replace(videos(), actions=None), {}, DataConfig()).lines)
    for key, measure in MEASURES.items():
        if measure.group == ACTIONS and key != "noise_size":
            assert (found[key].value, found[key].note) == (None, "no actions"), key
    assert found["noise_size"].value is not None


def test_probes_are_of_the_transitions_with_actions(model: WorldModel) -> None:
    real = videos().actions
    assert real is not None
    some = np.where(np.arange(len(real))[:, None] // LENGTH % 2, real, np.nan).astype(np.float32)
    lines = [make_card(model, replace(videos(), actions=part), {}, DataConfig()).lines for part in (real, some)]
    whole, half = map(by_key, lines)
    assert half["linear_probe"].note.endswith("; 36 of 72 transitions have actions")
    assert half["linear_probe"].value not in (None, whole["linear_probe"].value)
    assert half["codes_in_use"] == whole["codes_in_use"]
    few = replace(
        videos(), actions=np.where(np.arange(len(real))[:, None] < 4 * LENGTH, real, np.nan).astype(np.float32)
    )
    assert hold_out(few, {}, DataConfig(), 100).tested.tolist() == [9, 10, 11]
    assert hold_out(replace(few, unlabelled="b"), {}, DataConfig(), 100).tested.tolist() == [3, 10, 11]
    late = np.where(np.arange(len(real))[:, None] < 9 * LENGTH, real, np.nan).astype(np.float32)
    found = by_key(make_card(model, replace(videos(), actions=late), {}, DataConfig()).lines)
    assert found["linear_probe"].note == "no actions in the tested episodes, or in no others"


def test_one_episode_says_what_it_cannot_tell(model: WorldModel) -> None:
    found = by_key(make_card(model, videos(1), {}, DataConfig()).lines)
    assert found["linear_probe"].note == "no other episodes to fit a probe on"
    assert found["transfer"].note == found["sensitivity"].note == "a single held-out episode"
    assert found["moving_explained"].value is not None


@pytest.mark.parametrize("mode", ["continuous", "ground_truth", "none"])
def test_models_without_prototypes_or_latents_say_so(mode: Any) -> None:
    config = tiny_config(mode=mode)
    if mode == "none":
        config = replace(
            config, model=replace(config.model, predictor=replace(config.model.predictor, kind="ocvp_seq"))
        )
    other = WorldModel(config.model, config.env).eval()
    found = by_key(make_card(other, videos(4), {}, DataConfig()).lines)
    assert found["codes_in_use"].note == f"mode {mode} has no prototypes"
    assert (found["linear_probe"].value is None) == (mode != "continuous")
    assert (found["replay"].note == "this world model has no latent actions (mode none)") == (mode == "none")


def test_one_latent_a_slot_is_measured_too() -> None:
    found = by_key(make_card(tiny_agent_multi(), videos(4), {}, DataConfig()).lines)
    assert "of 8, over 24 latents" in found["directions"].note  # one held-out episode of six transitions, four slots
    assert found["linear_probe"].value is not None


def tiny_agent_multi() -> WorldModel:
    import torch

    config = tiny_config(multi=True)
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        torch.manual_seed(0)
        model = WorldModel(config.model, config.env)
        model.inverse_dynamics.split(torch.randn(64, model.inverse_dynamics.latent_dim))
        return model.eval()


def test_videos_without_motion_or_of_single_frames_are_refused(model: WorldModel) -> None:
    with pytest.raises(DataError, match="frames that never change"):
        make_card(model, videos(moving=False), {}, DataConfig())
    with pytest.raises(DataError, match="12 episodes of one frame"):
        make_card(model, videos(length=1), {}, DataConfig())


def test_the_world_models_own_videos_are_measured_where_its_validation_was(model: WorldModel) -> None:
    metas = {"dynamics": {"data": {"train": "print"}, "seed": 4}}
    found = hold_out(videos(), metas, DataConfig(validation=0.25), 100)
    assert found.tested.tolist() == split_episodes(EPISODES, 0.25, 4)[1].tolist()
    assert found.known
    assert not np.intersect1d(found.tested, found.fitted).size
    none = hold_out(videos(), metas, DataConfig(validation=0.0), 100)
    assert not none.known
    one = hold_out(videos(episodes=1), metas, DataConfig(validation=0.25), 100)
    assert (one.tested.tolist(), one.known) == ([0], False), "it was trained on"
    stored = {"dynamics": metas["dynamics"] | {"validation": 0.5}}
    assert hold_out(videos(), stored, DataConfig(validation=0.25), 100).tested.tolist() == (
        split_episodes(EPISODES, 0.5, 4)[1].tolist()
    )
    elsewhere = metas | {"slots": {"data": {"train": "print+more"}, "seed": 4}}
    mixed = hold_out(videos(), elsewhere, DataConfig(validation=0.25), 100)
    assert (mixed.tested.tolist(), mixed.known) == (found.tested.tolist(), False), "SAVi may have seen them"
    assert "slots had another set" in mixed.told_by
    lengths = np.where(np.isin(np.arange(EPISODES), split_episodes(EPISODES, 0.1, 4)[1]), 2, videos().lengths)
    short, clip = replace(videos(), lengths=lengths), metas["dynamics"] | {"clip_frames": 3}
    tested, clips = hold_out(short, {"dynamics": clip}, DataConfig(validation=0.1), 100).tested, Clips(short, 3, 0.1, 4)
    assert sorted([*tested, *clips.train_episodes]) == list(range(EPISODES))
    assert np.isin(clips.held_out[:, 0] // LENGTH, tested).all()
    both = {stage: {"data": {"train": "print"}, "seed": seed} for stage, seed in (("slots", 0), ("dynamics", 4))}
    shared = np.intersect1d(*(split_episodes(EPISODES, 0.5, seed)[1] for seed in (0, 4)))
    assert hold_out(videos(), both, DataConfig(validation=0.5), 100).tested.tolist() == shared.tolist() != []


def test_the_policys_demonstrations_are_measured_on_those_it_held_out() -> None:
    source = replace(videos(), origins=np.arange(EPISODES).astype(str))
    trained = split_demonstrations(source, 8, 3, 3, 0).trained.fingerprint
    policy = {"data": {"demos": trained}, "demos": 8, "held_out_demos": 3, "seed": 0}
    for held_out, seen, tested, known in (
        (3, ["0"], [9, 10, 11], True),
        (2, ["0"], [9, 10, 11], False),
        (3, None, [9, 10, 11], False),
        (3, ["0", "10"], [9, 11], True),
        (3, ["9", "10", "11"], [9, 10, 11], False),
    ):
        world = {"slots": {"held_out": held_out, "trained_on": seen}, "dynamics": {"held_out": 3, "trained_on": ["1"]}}
        found = hold_out(source, {"policy": policy, **world}, DataConfig(), 100)
        assert (found.tested.tolist(), found.known) == (tested, known)
    first, *rest = split_episodes(EPISODES, 0.5, 4)[1].tolist()
    own = {"dynamics": {"data": {"train": "print"}, "seed": 4, "trained_on": [str(first)]}}
    assert hold_out(source, own, DataConfig(validation=0.5), 100).tested.tolist() == rest, "a copy was trained on"
    assert hold_out(source, {"policy": policy | {"demos": 7}}, DataConfig(), 100).known is False
    named = hold_out(source, {}, DataConfig(held_out=2), 100)
    assert (named.tested.tolist(), named.known) == ([10, 11], False)
    actions = np.zeros((len(source.frames), 2), np.float32)
    actions[source.episode_rows(0)] = np.nan  # whose others are labelled first
    silent = replace(source, actions=actions, unlabelled="b")
    trained = split_demonstrations(silent, 8, 3, 3, None, acted=True).trained.fingerprint
    assert trained != split_demonstrations(silent, 8, 3, 3).trained.fingerprint
    told = hold_out(silent, {"policy": policy | {"data": {"demos": trained}}}, DataConfig(), 100).told_by
    assert told.startswith("the last 3 episodes, which are held out from the policy's training")


def test_at_most_so_many_episodes_are_taken_and_short_ones_left_out() -> None:
    source = videos()
    lengths = source.lengths.copy()
    lengths[[0, 11]] = 1
    found = hold_out(replace(source, lengths=lengths), {}, DataConfig(), 8)
    assert found.tested.tolist() == [9, 10]
    assert len(found.fitted) == 6
    assert not {0, 11} & {*found.tested.tolist(), *found.fitted.tolist()}


def test_effects_are_measured_over_as_many_steps_as_there_are(model: WorldModel) -> None:
    card = make_card(model, videos(length=3), {}, DataConfig())
    assert card.details["steps"] == 2
    assert {one.key for one in card.lines if one.group == EFFECTS} >= {"transfer", "constancy", "locality"}
