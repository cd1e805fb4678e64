"""What a key of the config counts for and which values it takes, said where the key is declared:
`field(default=0, metadata=role("machine") | at_least(0))`.

A key without a role says what is computed: it is stored with a run, handed on, and part of every identity.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Final, Literal

from playslot_rl.config.plain import check, to_dict, type_hints
from playslot_rl.episode_seeds import LARGEST_SEED

Role = Literal["call", "machine", "free", "folder"]
"""`call`: what one invocation does; a stored run does not hand it on.

`machine`: where, how loudly and of which names a job of a comparison is made, not what comes out.
`free`: how often and how long we look, and how a batch is computed where that only rounds otherwise; may differ when a
stage is resumed or found finished.
`folder`: one or several paths, in which a leading `~` is expanded.
"""


def role(*roles: Role) -> dict[str, Any]:
    """Metadata of a field that has these roles; those of a group hold for all of its keys."""
    return {"roles": frozenset(roles)}


def within(accepts: Callable[[Any], bool], expected: str) -> dict[str, Any]:
    """Metadata of a field that takes the values, each of a tuple, that `accepts` is true for, and None."""
    return {"range": (accepts, expected)}


def at_least(smallest: float, expected: str = "") -> dict[str, Any]:
    """Metadata of a field that takes numbers from `smallest` on."""
    return within(lambda value: value >= smallest, expected or f"at least {smallest}")


def between(smallest: float, largest: float, expected: str) -> dict[str, Any]:
    """Metadata of a field that takes numbers from `smallest` to `largest`, both included."""
    return within(lambda value: smallest <= value <= largest, expected)


SEED: Final = between(0, LARGEST_SEED, f"a non-negative integer of 32 bits, 0 to {LARGEST_SEED}")
"""Metadata of a field that takes seeds."""


class Checked:
    """A config whose fields are checked against the ranges in their metadata when it is made.

    Raises:
        ValueError: a value outside its range.
    """

    group: ClassVar[str] = ""
    """Dotted name with a dot at its end, for the messages; empty where several groups are of this class."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):  # type: ignore[arg-type]
            if "range" in field.metadata:
                accepts, expected = field.metadata["range"]
                value = getattr(self, field.name)
                for one in value if isinstance(value, tuple) else (value,):
                    check(one is None or accepts(one), self.group + field.name, one, expected)


def keys_of(cls: type, wanted: Role) -> frozenset[str]:
    """Dotted names of the keys and groups of a config class, at any depth, that have a role."""
    hints, found = type_hints(cls), set[str]()
    for field in dataclasses.fields(cls):
        if wanted in field.metadata.get("roles", ()):
            found.add(field.name)
        elif dataclasses.is_dataclass(hints[field.name]):
            found.update(f"{field.name}.{key}" for key in keys_of(hints[field.name], wanted))
    return frozenset(found)


def without(config: Any, unwanted: Role) -> dict[str, Any]:
    """Nested plain dict of a config, less the keys and groups that have a role."""
    values = to_dict(config)
    for key in keys_of(type(config), unwanted):
        *groups, name = key.split(".")
        level = values
        for group in groups:
            level = level[group]
        del level[name]
    return values


def fixed_keys(values: Mapping[str, Any]) -> dict[str, Any]:
    """What a resumed or finished training must share with these nested plain values: all keys that are not `free`."""
    from playslot_rl.config.experiment import ExperimentConfig

    free = {key.rpartition(".")[2] for key in keys_of(ExperimentConfig, "free")}
    return {
        key: fixed_keys(value) if isinstance(value, Mapping) else value
        for key, value in values.items()
        if key not in free
    }
