"""A method is one object: whatever is asked of it follows from that, and nobody asks for its name."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import pytest

import playslot_rl
from playslot_rl.config import plugins
from playslot_rl.config.methods import METHODS, Method

ROOT = Path(playslot_rl.__file__).parents[1]


def test_a_method_has_seven_members() -> None:
    assert len(fields(Method)) == 7


def compared_names(source: str) -> Iterator[ast.Compare]:
    """Comparisons with the name of a method."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Compare) and re.search(r"method|trained_as|stage", ast.unparse(node)):
            listed = [part for side in node.comparators for part in getattr(side, "elts", [])]
            equal = isinstance(node.ops[0], ast.Eq | ast.NotEq)
            sides = [node.left, *node.comparators] if equal else listed
            if any(isinstance(part, ast.Constant) and part.value in METHODS for part in sides):
                yield node


@pytest.mark.parametrize("folder", ["playslot_rl", "recipes", "collectors", "envs"])
def test_nothing_asks_whether_a_method_is_a_certain_one(folder: str) -> None:
    found = [
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for path in sorted((ROOT / folder).rglob("*.py"))
        for node in compared_names(path.read_text())
    ]
    assert not found


def test_a_name_that_is_asked_for_would_be_found() -> None:
    assert list(compared_names('x = method in ("lapo", "other")'))
    assert not list(compared_names('x = kind == "other"'))


@pytest.mark.parametrize("name", METHODS)
def test_what_a_method_names_is_there(name: str) -> None:
    method = METHODS[name]
    stages = {stage.name for stage in method.stages} | {"slots", "dynamics"}
    assert method.name == name
    for stage in method.stages:
        assert set(stage.parents) <= stages
        for reference in filter(None, (stage.parts, stage.sizes, method.load.actor, method.load.video)):
            module, _, function = reference.partition(":")
            assert callable(getattr(__import__(module, fromlist=[function]), function))


def test_traits_follow_from_stages() -> None:
    def named(trait: str) -> set[str]:
        return {name for name, method in METHODS.items() if getattr(method, trait)}

    assert named("online") == {"dreamer", "sold"}
    assert named("slots") == {
        "playslot",
        "slot_vpt",
        "lapo_slots",
        "slot_oracle",
        "slot_bc",
        "sold",
        "slotformer",
        "ocvp_seq",
    }
    assert named("some_labelled") == {"slot_vpt", "playslot", "lapo", "lapo_slots", "laom", "clam", "caddy_policy"}
    assert named("one_policy") == named("some_labelled") - {"slot_vpt", "clam"}
    assert named("labelled_only") == {
        "slot_bc", "resnet_bc", "history_bc", "act", "act_state", "diffusion", "diffusion_state", "autoencoder_bc",
        "inverse_bc",
    }  # fmt: skip
    assert {name: m.model.name for name, m in METHODS.items() if m.model} == {
        "lapo": "lapo_model", "lapo_slots": "lapo_slots_model", "laom": "laom_model", "clam": "clam_model",
        "caddy_policy": "caddy", "caddy_oracle": "caddy", "autoencoder_bc": "autoencoder",
        "inverse_bc": "inverse_resnet",
    }  # fmt: skip
    assert named("imagines") == {"playslot"}


def test_nothing_of_a_method_is_imported_before_it_is_named() -> None:
    assert plugins.brought("playslot_rl.nothing") == {}
