"""`playslot compare` takes lists, and hands `hydra.` keys on."""

from __future__ import annotations

import pytest

from playslot_rl.config.compose import compose
from playslot_rl.errors import ConfigError


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
    ],
)
def test_bad_lists_are_refused(typed: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        compose([typed], "compare")
