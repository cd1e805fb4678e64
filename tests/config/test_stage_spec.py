"""A stage says what identifies it by the full names of the config; what came later is known by these, too."""

from __future__ import annotations

from typing import Any

import pytest

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.roles import earlier
from playslot_rl.config.stage_spec import StageSpec
from playslot_rl.methods.lapo.method import POLICY as LAPO
from playslot_rl.methods.playslot.method import POLICY
from playslot_rl.methods.slot_oracle.method import STAGE as ORACLE
from playslot_rl.storage.resume import first_difference


@pytest.mark.parametrize(
    ("spec", "key", "stored", "begun"),
    [
        (POLICY, "behaviour.loss", "policy.loss", "policy.loss"),
        (ORACLE, "behaviour.optim.lr", "slot_oracle.optim.lr", "slot_oracle.optim.lr"),
        (LAPO, "baselines.lapo.code_dim", "lapo.code_dim", "lapo.code_dim"),
        (LAPO, "baselines.lapo.shift", "lapo.shift", "shift"),
        (LAPO, "model.action_decoder.hidden_dim", "model.action_decoder.hidden_dim", "action_decoder.hidden_dim"),
        (LAPO, "env.image_size", "env.image_size", "env.image_size"),
    ],
)
def test_a_key_has_its_old_name_in_a_checkpoint_and_its_full_one_in_a_message(
    spec: StageSpec, key: str, stored: str, begun: str
) -> None:
    assert (spec.stored_name(key), spec.stored_name(key, begun=True)) == (stored, begun)
    assert spec.typed(stored) == spec.typed(begun) == key


def test_a_key_that_came_later_is_known_by_its_full_name_alone() -> None:
    """Such as `kind`, which `model.predictor` had not always: another group's key of that name has no history."""
    known = earlier(ExperimentConfig)
    assert known["model.predictor.kind"] == "cocvp"
    assert "plan.kind" not in known
    spec = StageSpec("mine", keys=("model.predictor.kind", "render.kind"))
    wanted = {"model": {"predictor": {"kind": "cocvp"}}, "render": {"kind": "cocvp"}}
    assert first_difference({}, wanted, spec.typed) == ("render.kind", "nothing", "cocvp")
    assert first_difference({"render": {"kind": "cocvp"}}, wanted, spec.typed) is None


@pytest.mark.parametrize(
    ("stored", "wanted", "expected"),
    [
        ({"behaviour": {"policy_from": "a"}}, {"behaviour": {"policy_from": "b"}}, None),
        ({"behaviour": {"policy_from": "a"}}, {}, None),
        (
            {"slots": {"start_from": "a"}, "started_from": "1"},
            {"slots": {"start_from": "b"}, "started_from": "1"},
            None,
        ),
        (
            {"slots": {"start_from": "a"}, "started_from": "1"},
            {"slots": {"start_from": "a"}, "started_from": "2"},
            ("started_from", "1", "2"),
        ),
        (
            {"slots": {"start_from": ""}},
            {"slots": {"start_from": "b"}, "started_from": "1"},
            ("slots.start_from", "", "b"),
        ),
    ],
)
def test_a_place_is_no_difference_where_what_lies_there_is_the_same(
    stored: dict[str, Any], wanted: dict[str, Any], expected: tuple[str, str, str] | None
) -> None:
    assert first_difference(stored, wanted) == expected


def test_what_a_checkpoint_keeps_follows_from_its_keys() -> None:
    assert POLICY.groups == ("env", "model", "behaviour")
    assert LAPO.groups == ("env", "model", "behaviour", "baselines.lapo")
