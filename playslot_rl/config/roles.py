"""What a key of the config counts for and which values it takes, said where the key is declared:
`field(default=0, metadata=role("machine") | at_least(0))`.

A key without a role says what is computed: it is stored with a run, handed on, and part of every identity. Every number
has bounds (`tests/config/test_bounds.py`).
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, ClassVar, Final, Literal

from playslot_rl.config.plain import check, flatten, place_of, put, to_dict, type_hints
from playslot_rl.seeds.episodes import EPISODES, LARGEST_SEED

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


LARGEST: Final = 10**9
"""The largest number that a field takes which names no other: beyond it there are only slips."""


@dataclasses.dataclass(frozen=True)
class Bounds:
    """Which values a field takes, each of a tuple, None always, and what they are in words. Numbers outside of
    `smallest` and `largest` are refused; for text these are None.
    """

    accepts: Callable[[Any], bool]
    expected: str
    smallest: float | None = None
    largest: float | None = None

    def refused(self, value: Any) -> str:
        """What is expected instead of a value; empty where it is accepted."""
        if self.smallest is None or self.largest is None:
            return "" if self.accepts(value) else self.expected
        if isinstance(value, float) and not math.isfinite(value):
            return f"a finite number, {self.expected}"
        if value > self.largest:
            most = f"{self.largest:.17g}"
            return self.expected if most in self.expected else f"{self.expected}, {most} at most"
        return "" if value >= self.smallest and self.accepts(value) else self.expected


def text(accepts: Callable[[str], bool], expected: str) -> dict[str, Any]:
    """Metadata of a field that takes texts which `accepts` is true for."""
    return {"bounds": Bounds(accepts, expected)}


def within(
    accepts: Callable[[Any], bool], expected: str, smallest: float = 0, largest: float = LARGEST
) -> dict[str, Any]:
    """Metadata of a field that takes numbers from `smallest` to `largest` which `accepts` is true for."""
    return {"bounds": Bounds(accepts, expected, smallest, largest)}


def at_least(smallest: float, expected: str = "", largest: float = LARGEST) -> dict[str, Any]:
    """Metadata of a field that takes numbers from `smallest` on, and up to `largest`."""
    return within(lambda value: value >= smallest, expected or f"at least {smallest}", smallest, largest)


def between(smallest: float, largest: float, expected: str) -> dict[str, Any]:
    """Metadata of a field that takes numbers from `smallest` to `largest`, both included."""
    return within(lambda value: smallest <= value <= largest, expected, smallest, largest)


def above_zero(expected: str = "above 0", largest: float = LARGEST) -> dict[str, Any]:
    """Metadata of a field that takes numbers above 0, and up to `largest`."""
    return within(lambda value: value > 0, expected, 0, largest)


def below_one(expected: str = "a fraction in [0, 1)") -> dict[str, Any]:
    """Metadata of a field that takes fractions from 0 to below 1."""
    return within(lambda value: value < 1, expected, 0, 1)


OPEN_FRACTION: Final = within(lambda value: 0 < value < 1, "a number in (0, 1)", 0, 1)
SEED: Final = between(0, LARGEST_SEED, f"a non-negative integer of 32 bits, 0 to {LARGEST_SEED}")
"""Metadata of a field that takes seeds."""
NOT_NEGATIVE: Final = at_least(0, "0 or more")
COUNT: Final = at_least(1)
"""Metadata of a width, or of a number of steps or things."""
LAYERS: Final = between(1, 1000, "1 to 1000")
"""Metadata of what is computed one after the other: layers, or iterations."""
RATE: Final = at_least(0, "0 or more", 1e40)
"""Metadata of a learning rate; one that diverges is said by the training."""
YEAR_MINUTES: Final = 525_600
UNSAID: Final = {"unsaid": True}
"""Metadata of a field that plain values name only where it differs from its default, so that configs, identities and
data sets from before it are the same."""
EPISODE_COUNT: Final = at_least(0, "0 or more", EPISODES)
"""Metadata of a number of episodes that are recorded with one seed."""


class Checked:
    """A config whose fields are checked against the bounds in their metadata when it is made (ValueError)."""

    group: ClassVar[str] = ""
    """Dotted name with a dot at its end, for the messages; empty where several groups are of this class."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):  # type: ignore[arg-type]
            if "bounds" in field.metadata:
                bounds, value = field.metadata["bounds"], getattr(self, field.name)
                for one in value if isinstance(value, tuple) else (value,):
                    expected = "" if one is None else bounds.refused(one)
                    check(not expected, self.group + field.name, one, expected)


@functools.cache
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
    for key in keys_of(type(config), unwanted):  # type: ignore[arg-type]
        group, name = place_of(values, key)
        del group[name]
    return values


def was(value: Any) -> dict[str, Any]:
    """Metadata of a field that came after the first checkpoints, and what those were trained with."""
    return {"was": value}


def set_by(key: str) -> dict[str, Any]:
    """Metadata of a field that another key sets, by its dotted name: it is stored with a model, and not typed."""
    return {"set_by": key}


@functools.cache
def declared(cls: type, what: str) -> dict[str, Any]:
    """What the metadata of a config class's keys and groups say of something, by their dotted names."""
    hints, found = type_hints(cls), dict[str, Any]()
    for field in dataclasses.fields(cls):
        if what in field.metadata:
            found[field.name] = field.metadata[what]
        elif dataclasses.is_dataclass(hints[field.name]):
            found.update({f"{field.name}.{key}": said for key, said in declared(hints[field.name], what).items()})
    return found


def earlier(cls: type) -> dict[str, Any]:
    """What checkpoints that do not name a key were trained with, by the dotted names of a config class's keys."""
    return declared(cls, "was")


def naming(config: Any) -> dict[str, Any]:
    """What names a job of a comparison, nested: all but the keys of the machine. One that is left open, None, counts as
    what it `was`, so that jobs from before it could be are the same jobs.
    """
    flat = flatten(values := without(config, "machine"))
    for key, value in earlier(type(config)).items():
        if flat.get(key, value) is None:
            put(values, key, value)
    return values


def by_default[Config](config: Config, unwanted: Role) -> Config:
    """A config whose keys of a role have their defaults again; those of groups inside it stay."""
    names = [field for field in dataclasses.fields(config) if unwanted in field.metadata.get("roles", ())]  # type: ignore[arg-type]
    return dataclasses.replace(config, **{field.name: field.default for field in names})  # type: ignore[type-var]
