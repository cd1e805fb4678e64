"""What a card is worth: dead world models of many kinds are not praised, and the shipped ones keep their verdicts."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from squares import videos

from playslot_rl.config import DataConfig
from playslot_rl.evaluation.card import Card, card_json, make_card
from playslot_rl.evaluation.card_lines import MEASURES, NEEDS, NO_NUMBERS, Line, conclude, line, settle, worthless
from playslot_rl.evaluation.latent_lines import _probe_lines
from playslot_rl.runs import Run
from playslot_rl.world_model import WorldModel

PAGE = Path(__file__).parents[2] / "docs" / "results" / "cards.md"
PROBES = {"linear_probe", "mlp_probe"}


def random_weights(model: WorldModel) -> None:
    for parameter in model.parameters():
        if parameter.ndim > 1:
            torch.nn.init.xavier_uniform_(parameter)


def one_code(model: WorldModel) -> None:
    codebook = model.inverse_dynamics.get_buffer("quantizer.vq._codebook.embed")
    codebook[:, 1:] += 1e6


def constant_slots(model: WorldModel) -> None:
    for parameter in model.savi.encoder.parameters():
        parameter.zero_()


def constant_latents(model: WorldModel) -> None:
    for parameter in model.inverse_dynamics.parameters():
        parameter.zero_()


def deaf_predictor(model: WorldModel) -> None:
    for parameter in model.predictor.parameters():
        parameter.zero_()


def not_numbers(model: WorldModel) -> None:
    for parameter in model.parameters():
        parameter.fill_(math.nan)


def latents_not_numbers(model: WorldModel) -> None:
    for parameter in model.inverse_dynamics.parameters():
        parameter.fill_(math.nan)


KINDS = (
    random_weights, one_code, constant_slots, constant_latents, deaf_predictor, not_numbers, latents_not_numbers
)  # fmt: skip


def card_of(damage: Callable[[WorldModel], None], name: str) -> Card:
    model = copy.deepcopy(Run.open(name).load_world_model("cpu"))
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        torch.manual_seed(0)
        damage(model)
    return make_card(model, videos(), {}, DataConfig())


@pytest.mark.integration
@pytest.mark.parametrize(
    "name", ["pretrained/button_press", pytest.param("pretrained/block_push_easy", marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("damage", KINDS)
def test_a_dead_model_is_not_praised(damage: Callable[[WorldModel], None], name: str) -> None:
    card = card_of(damage, name)
    found = {one.key: one for one in card.lines}
    assert list(found) == list(MEASURES)
    for one in card.lines:
        assert (one.value is None) == (one.verdict == "not measured"), one
        if one.verdict == "good":  # then so far as known, all it builds on is worth something
            for group in NEEDS.get(one.key, ()):
                parts = [found[key] for key in group]
                assert any(p.value is not None and not worthless(p.key, p.value) for p in parts), (one.key, group)
    probes = [found[key].value for key in PROBES]
    if all(value is None or value <= 0 for value in probes):
        assert {found[key].verdict for key in ("above_frame", "lag", "noise_probe")} <= {"not measured", "bad"}
    result = json.loads(json.dumps(card_json(card, videos(), {}, 0.0), allow_nan=False))
    assert result["verdict"]["usable"] is False
    assert result["verdict"]["reason"]
    if damage in (not_numbers, latents_not_numbers):
        assert {one.note for one in card.lines} == {result["verdict"]["reason"]} == {NO_NUMBERS}


def of_the_page() -> dict[str, list[Line]]:
    """The cards of the shipped models as docs/results/cards.md tells them."""
    rows = [row.strip("|").split("|") for row in PAGE.read_text().splitlines() if row.startswith(("| `", "| line"))]
    names = [name.strip() for name in next(row for row in rows if row[0].strip() == "line")[1:]]
    cards: dict[str, list[Line]] = {name: [] for name in names}
    for row in (row for row in rows if len(row) == 1 + len(names) and row[0].strip(" `") in MEASURES):
        key = row[0].strip(" `")
        for name, cell in zip(names, row[1:], strict=True):
            if not cell.strip():
                cards[name].append(line(key, None, "not measured there"))
                continue
            value, verdict = cell.split()
            told: Any = verdict.lower()  # a value at a border was rounded
            cards[name].append(replace(line(key, float(value)), verdict=told))
    return cards


def test_the_shipped_models_keep_their_verdicts() -> None:
    cards = of_the_page()
    assert len(cards) == 4
    for name, lines in cards.items():
        assert [one.key for one in lines] == list(MEASURES)
        assert settle(lines) == lines, name
        assert conclude([one.plain() for one in lines]).usable, name


def probed(latent: float, frame: float, late: float) -> dict[str, Line]:
    """Lines of probes with these R²."""
    controls = {"shuffled": -0.1, "noise": -0.1}
    scores = {
        name: {"linear": {"mean_r2": r2}, "mlp": {"mean_r2": r2 - 0.4}, "test": 9, "train": 9, "test_episodes": 3}
        for name, r2 in {"latent": latent, "frame": frame, "prompt": latent, "late": late, **controls}.items()
    }
    return {one.key: one for one in settle(list(_probe_lines(scores, "").values()))}


def test_the_difference_of_two_probes_that_find_nothing_is_no_measure() -> None:
    """`above_frame 0.31 good` where both R² are below -1."""
    dead = probed(latent=-1.1, frame=-1.41, late=-2.0)
    for key in ("above_frame", "lag", "shuffled_probe", "noise_probe"):
        assert dead[key].verdict == "not measured", key
        assert "no probe recovers the action" in dead[key].note
    assert "-1.10" in dead["above_frame"].note
    assert "-1.41" in dead["above_frame"].note
    weak = probed(latent=0.12, frame=-1.41, late=-2.0)
    assert weak["above_frame"].value == pytest.approx(0.17)  # not 1.53: the frame's probe failed, and says nothing
    assert weak["lag"].value == pytest.approx(-0.17)
    late = probed(latent=-0.4, frame=0.2, late=0.8)
    assert (late["above_frame"].verdict, late["lag"].verdict) == ("not measured", "bad")


GOOD = {key: measure.borders[0] for key, measure in MEASURES.items()}


def judged(changes: dict[str, float | None], counts: tuple[int, ...] = (), tested: int = 9) -> str:
    lines = [line(key, value, "why") for key, value in (GOOD | changes).items()]
    return str(conclude([one.plain() for one in settle(lines)], counts, tested))


def test_a_few_episodes_do_not_tell_and_no_probe_of_them_decides() -> None:
    dead = {"linear_probe": -0.15, "mlp_probe": -0.3}
    few = "verdict: usable: replay 0.70; too few episodes to tell: 3 tested, expected 4 or more"
    assert judged({}, tested=3) == few
    assert judged(dict(dead), tested=3).startswith(few)
    assert judged(dict(dead), tested=4).startswith("verdict: not usable: no probe")
    assert judged({"replay": 0.1}, tested=3).startswith("verdict: not usable: replayed latents")


def test_the_verdict_names_what_decides_it() -> None:
    assert judged({}) == "verdict: usable: replay 0.70"
    assert judged({"flicker": 0.5}) == "verdict: usable: replay 0.70; weak: flicker"
    for wrong, changes in {
        "what moves is not drawn (moving_explained 0.02)": {"moving_explained": 0.02, "replay": 0.0},
        "all slots share all pixels (mask_entropy 0.99)": {"mask_entropy": 0.99},
        "few slots hold everything (slots_in_use 0.25)": {"slots_in_use": 0.25},
        "replayed latents do not move the slots as these moved (replay 0.10)": {"replay": 0.1},
        "the future hardly depends on the latents (sensitivity 0.01)": {"sensitivity": 0.01},
        "no probe recovers the action from the latent (R² -0.10)": {"linear_probe": -0.1, "mlp_probe": -0.3},
        "replay could not be measured: why": {"replay": None},
    }.items():
        assert judged(dict(changes)) == f"verdict: not usable: {wrong}"
    assert judged({}, (99, 1, 0)) == "verdict: not usable: one of 3 prototypes holds 99% of the transitions"
    assert judged({}, (90, 10, 0)) == "verdict: usable: replay 0.70"
    assert judged({"linear_probe": None, "mlp_probe": None}) == "verdict: usable: replay 0.70"  # a set without actions
