"""`playslot compare` takes lists, and hands `hydra.` keys on."""

from __future__ import annotations

import pytest

from playslot_rl.config.compose import compose
from playslot_rl.errors import ConfigError
from playslot_rl.seeds.episodes import TEST_BLOCKS


def test_lists_are_typed_with_commas_or_in_brackets() -> None:
    for typed in (
        ["demos=10,50", "seeds=3", "methods=lapo,sold"],
        ["demos=[10,50]", "seeds=[3]", "methods=[lapo,sold]"],
    ):
        wanted = compose(typed, "compare").compare
        assert (wanted.demos, wanted.seeds, wanted.methods) == ((10, 50), (3,), ("lapo", "sold"))


def test_elsewhere_demos_is_a_number() -> None:
    assert compose(["demos=10"], "train-policy").demos == 10
    with pytest.raises(ConfigError):
        compose(["demos=10,50"], "train-policy")


def test_hydras_keys_are_kept_as_they_are() -> None:
    typed = ["hydra.launcher=joblib", "hydra.launcher.n_jobs=2", "hydra.launcher.x='it''s ${a}'"]
    wanted = compose(typed, "compare").compare
    assert wanted.launcher == "joblib"
    assert wanted.hydra == tuple(typed[1:])
    with pytest.raises(ConfigError, match=r"unknown key hydra\.launcher"):
        compose(["hydra.launcher=joblib"], "collect")


@pytest.mark.parametrize(
    ("typed", "message"),
    [
        ("methods=playslot,lapoo", "compare.methods: got 'lapoo', expected one of playslot, slot_oracle"),
        ("methods=", "methods: got .*, expected at least one"),
        ("demos=10,10", "demos: got .*, expected each one once"),
        ("demos=0", "demos: got .*, expected numbers of at least 1"),
        ("demos=ten", "compare.demos: got 'ten'"),
        ("seeds=-1", "seeds: got .*, expected a non-negative integer of 32 bits"),
        ("hydra.launcher=slurm", "hydra.launcher: got 'slurm', expected one of basic, joblib"),
        ("hydra.launcher.n_jobs=2", "expected hydra.launcher=NAME with it"),
        ("demo=10", "unknown key demo: .*; did you mean demos"),
        ("labels=0", "labels: got .*0.*, expected numbers of at least 1"),
        ("labels=5,5", "labels: got .*, expected each one once"),
        ("labels=200 demos=100,300", "labels: got 200, expected at most the 100 demonstrations"),
        ("methods=slot_bc,lapo", "labels: got .*, expected some numbers with methods=slot_bc"),
        ("labels=few", "compare.labels: got 'few'"),
        ("videos=0,50", "videos: got .*, expected numbers of labelled demonstrations, labels=, with them"),
        ("videos=0 labels=5 demos=10", "demos: got .*, expected none with videos="),
        ("videos=-1 labels=5", "videos: got -1, expected numbers of 0 or more"),
        ("worlds=0", "worlds: got 0, expected 1 to 100"),
        ("methods=lapo compare.reference=slot_oracle", "reference: got 'slot_oracle', expected one of lapo"),
        ("compare.block=test compare.evaluation_seed=7", "evaluation_seed: got 7, expected none, or 2147483648"),
        (f"compare.evaluation_seed={TEST_BLOCKS}", "evaluation_seed: got 2147483648, expected compare.block=test"),
    ],
)
def test_what_cannot_be_asked_is_one_line(typed: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as error:
        compose(["preset=compact", *typed.split()], "compare")
    assert "\n" not in str(error.value)
