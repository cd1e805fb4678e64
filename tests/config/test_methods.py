"""Methods are taken by the names people type."""

from __future__ import annotations

import pytest

from playslot_rl.config.compose import compose
from playslot_rl.config.methods import METHODS, canonical_method
from playslot_rl.errors import ConfigError


def spellings(name: str) -> list[str]:
    words = [name, *METHODS[name].titles]
    return [form for w in words for form in (w, w.upper(), w.lower(), w.replace(" ", "-"), w.replace("_", " "))]


@pytest.mark.parametrize("name", METHODS)
def test_every_spelling_of_a_method_is_that_method(name: str) -> None:
    acts = METHODS[name].acts
    assert {canonical_method(text, acts) for text in spellings(name)} == {name}
    word = name if METHODS[name].title == "CADDY" else METHODS[name].title  # two methods' title, see below
    assert compose([f"method={word}"], "train-baseline").method == name
    wanted = [f"methods='{METHODS[name].title}'", *["labels=5"] * METHODS[name].labelled_only]
    if acts:
        assert compose(wanted, "compare").compare.methods == (name,)
    elif name != "caddy":
        with pytest.raises(ConfigError, match=f"methods: got '{name}', expected methods that act"):
            compose(wanted, "compare")


@pytest.mark.parametrize("acts", [True, False])
def test_no_spelling_is_that_of_two_methods_that_act_or_of_two_that_do_not(acts: bool) -> None:
    names = [name for name in METHODS if METHODS[name].acts == acts]
    plain = [{text.lower().translate({ord(c): None for c in " -_"}) for text in spellings(name)} for name in names]
    assert sum(map(len, plain)) == len(set().union(*plain))


def test_caddy_acts_where_methods_that_act_are_compared_and_predicts_videos_elsewhere() -> None:
    for text in ("CADDY", "caddy"):
        assert compose([f"methods={text}"], "compare").compare.methods == ("caddy_policy",)
        assert compose([f"method={text}"], "train-baseline").method == "caddy"


def test_lists_may_mix_spellings() -> None:
    wanted = compose(["methods=[dreamerv3, Slot Oracle,'ResNet', lapo]"], "compare").compare
    assert wanted.methods == ("dreamer", "slot_oracle", "resnet_oracle", "lapo")
    assert compose(["compare.methods=[DreamerV3]"], "compare").compare.methods == ("dreamer",)
    with pytest.raises(ConfigError, match=r"methods: got .*, expected each one once"):
        compose(["methods=dreamer,DreamerV3"], "compare")


def test_an_unknown_method_is_one_line_with_the_nearest() -> None:
    with pytest.raises(ConfigError, match=r"^method: got 'dreamerv2', expected one of playslot, .*mean dreamer\?$"):
        compose(["method=dreamerv2"], "train-baseline")
