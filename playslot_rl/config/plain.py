"""Configs as plain values: dataclass to nested dict and back, strictly."""

from __future__ import annotations

import dataclasses
import difflib
import functools
import hashlib
import json
import math
import types
import typing
from collections.abc import Iterable, Mapping
from typing import Any, Literal, Union, get_args, get_origin


def check(ok: bool, what: str, got: object, expected: str) -> None:
    """Refuse a value out of range by a ValueError: one line that says what was got and what was expected."""
    if not ok:
        raise ValueError(f"{what}: got {shortened(got)}, expected {expected}")


def shortened(value: object) -> str:
    """A value as it is said in a message: one that is long by its beginning.

    Examples:
        >>> shortened("smol"), shortened(10**400)
        ("'smol'", '1000000000000000000000000... (about 1e400)')
    """
    if isinstance(value, int) and abs(value) >= 10**40:
        digits = math.floor(value.bit_length() * math.log10(2))
        return f"{'-' if value < 0 else ''}{abs(value) // 10 ** max(0, digits - 24)}... (about 1e{digits})"
    text = repr(value)
    return text if len(text) <= 200 else f"{text[:160]}... ({len(text)} characters)"


def nearest(text: str, known: Iterable[str], prefix: str = "", most: int = 1) -> str:
    """The end of a message about an unknown name: the known one that it may be meant for, if one is near; with `most`
    above 1 the nearest of all, near or not.

    Examples:
        >>> nearest("smol", ["smoke", "paper"], "preset=")
        '; did you mean preset=smoke?'
    """
    near = difflib.get_close_matches(text, [str(name) for name in known], most, 0.6 if most == 1 else 0.0)
    meant = " or ".join(f"{prefix}{name}" for name in near)
    return f"; did you mean {meant}?" if near else ""


def to_dict(config: Any) -> dict[str, Any]:
    """Nested plain dict of a config (tuples become lists, as in JSON); fields marked `roles.UNSAID` only where they
    differ from their default."""
    plain: dict[str, Any] = json.loads(json.dumps(_plain(config)))
    return plain


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        fields = ((field, getattr(value, field.name)) for field in dataclasses.fields(value))
        said = ((f.name, inner) for f, inner in fields if "unsaid" not in f.metadata or inner != f.default)
        return {name: _plain(inner) for name, inner in said}
    return [_plain(inner) for inner in value] if isinstance(value, list | tuple) else value


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested dicts as one dict with dotted keys."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        name = f"{prefix}{key}"
        flat.update(flatten(value, f"{name}.") if isinstance(value, Mapping) else {name: value})
    return flat


def place_of(values: dict[str, Any], key: str) -> tuple[dict[str, Any], str]:
    """The group of nested dicts that a dotted key is in, made where it is missing, and the key's name there."""
    *groups, name = key.split(".")
    for group in groups:
        values = values.setdefault(group, {})
    return values, name


def put(values: dict[str, Any], key: str, value: Any) -> None:
    """Set a dotted key of nested dicts."""
    group, name = place_of(values, key)
    group[name] = value


def merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Nested dicts with the values of the second where both have one."""
    both = dict(base)
    for key, value in changes.items():
        if isinstance(value, Mapping) and isinstance(both.get(key), dict):
            both[key] = merged(both[key], value)
        else:
            both[key] = value
    return both


def multiplied(values: Mapping[str, Any], factors: Mapping[str, Any]) -> dict[str, Any]:
    """Values times factors of the same nesting, lists number by number; integers are rounded, and none that was above 0
    falls to it.
    """

    def times(value: Any, factor: Any) -> Any:
        if isinstance(value, Mapping):
            return multiplied(value, factor)
        if isinstance(value, list | tuple):
            return [times(one, factor) for one in value]
        return max(min(value, 1), round(value * factor)) if isinstance(value, int) else value * factor

    return {**values, **{key: times(values[key], factor) for key, factor in factors.items()}}


def fingerprint(config: Any) -> str:
    """Short content hash of a config: equal configs, equal names."""
    text = json.dumps(to_dict(config), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def type_hints(cls: Any) -> dict[str, Any]:
    """Types of a class's fields, by name, evaluated once; a class with a method `whole` stands for what that gives."""
    return _type_hints(cls)


@functools.cache
def _type_hints(cls: Any) -> dict[str, Any]:
    hints = typing.get_type_hints(cls)
    return {name: hint.whole() if hasattr(hint, "whole") else hint for name, hint in hints.items()}


def from_dict[T](cls: type[T], values: dict[str, Any], where: str = "") -> T:
    """Build a config from nested plain values; missing keys keep their defaults. A ValueError, with the prefix `where`,
    for an unknown key, a wrong type, or a value outside its range.
    """
    hints = type_hints(cls)
    names = {f.name for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
    for key in values:
        if key not in names:
            hint = nearest(str(key), sorted(names), where)
            raise ValueError(f"unknown key {where}{key}: expected one of {', '.join(sorted(names))}{hint}")
    kwargs = {key: _convert(hints[key], value, f"{where}{key}") for key, value in values.items()}
    try:
        return cls(**kwargs)
    except ValueError as error:  # of a class that several groups share, by its name alone
        group = where.rstrip(".")
        raise ValueError(str(error) if group in str(error) else f"{error} (of {group})") from error


def _convert(hint: Any, value: Any, where: str) -> Any:
    origin = get_origin(hint)
    if dataclasses.is_dataclass(hint):
        if not isinstance(value, dict):
            raise ValueError(f"{where}: got {shortened(value)}, expected a group of keys")
        return from_dict(typing.cast(type, hint), value, f"{where}.")
    if origin is Literal:
        if value not in get_args(hint):
            raise ValueError(f"{where}: got {shortened(value)}, expected one of {', '.join(map(str, get_args(hint)))}")
        return value
    if origin in (Union, types.UnionType):
        if value is None:
            return None
        return _convert(next(a for a in get_args(hint) if a is not type(None)), value, where)
    if origin is tuple:
        if not isinstance(value, (list, tuple)):
            raise ValueError(f"{where}: got {shortened(value)}, expected a list")
        return tuple(_convert(get_args(hint)[0], v, where) for v in value)
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError:
            raise ValueError(f"{where}: got {shortened(value)}, expected a number that a float can hold") from None
    if hint is str and value is None:
        return ""
    if not isinstance(value, hint) or (hint is int and isinstance(value, bool)):
        raise ValueError(f"{where}: got {shortened(value)} ({type(value).__name__}), expected {hint.__name__}")
    return value
