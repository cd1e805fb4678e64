"""What `--help` says of the keys that a command reads: names, defaults and words come from the fields."""

from __future__ import annotations

import dataclasses
import inspect
import re
import textwrap
from collections.abc import Sequence
from typing import Any, Final, Literal, cast, get_args, get_origin

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.compose import COMPARISONS, GROUPS, NAMES, choices, hint_of
from playslot_rl.config.plain import type_hints
from playslot_rl.config.roles import keys_of

WIDTH: Final = 110
_COLUMN: Final = 22
_INLINE: Final = 7
"""A group of more keys has a row of its own."""
_CHOSEN: Final = {"env": "the task", "preset": "sizes and schedule"}


def explained(command: str, keys: Sequence[str]) -> str:
    """The keys of a command as text: single ones, `seed` or `data.root`, and groups, `slots`; `env` means both.

    Examples:
        >>> print(explained("bench", ["threads"]))
        keys:
          threads=0           torch threads; 0 leaves torch's choice
    """
    names = dict.fromkeys(keys)
    single = [key for key in names if key in GROUPS or not _is_group(key)]
    single.sort(key=lambda key: key.count("."))
    lines = ["keys:", *(_line(f"{key}={_shown(key)}", _words(key)) for key in single)]
    rows = [row for key in names if _is_group(key) for row in _rows(command, key)]
    if rows:
        lines += ["", "keys of groups, as in slots.steps=100 (the preset decides their defaults):"]
        lines += [_line(group, words) for group, words in rows]
    return "\n".join(lines)


def _rows(command: str, group: str) -> list[tuple[str, str]]:
    """Names of a group's keys; a group of groups has a row for each of them."""
    names, inner = [], []
    for name, hint in fields_of(hint_of(group)).items():
        if not dataclasses.is_dataclass(hint):
            names.append(name)
        elif all(map(dataclasses.is_dataclass, fields_of(hint_of(group)).values())) or len(fields_of(hint)) > _INLINE:
            inner += _rows(command, f"{group}.{name}")
        else:
            names.append(f"{name}.{{{','.join(fields_of(hint))}}}")
    if group.replace("_", "-") != command:
        return ([(f"{group}.", " ".join(names))] if names else []) + inner
    short = [name for name in names if name in COMPARISONS.get(command, ()) or name in NAMES.get(command, ())]
    words = [f"{name}=" for name in short]
    if command in COMPARISONS:
        words += ["hydra.launcher=", "hydra.launcher.KEY="]
    own = [name for name in names if name not in (*short, "launcher", "hydra")]
    return ([("without a group:", " ".join(words))] if words else []) + [(f"{group}.", " ".join(own)), *inner]


def fields_of(cls: Any) -> dict[str, Any]:
    """The fields of a config class, with their types."""
    hints = type_hints(cls)
    return {field.name: hints[field.name] for field in dataclasses.fields(cls)}


def _is_group(key: str) -> bool:
    return dataclasses.is_dataclass(hint_of(key))


def _owner(key: str) -> tuple[type, str]:
    group, _, name = key.rpartition(".")
    return cast(type, hint_of(group) if group else ExperimentConfig), name


def _shown(key: str) -> str:
    """The default of a key, or what may stand there."""
    if key in GROUPS:
        return "NAME"
    owner, name = _owner(key)
    if get_origin(hint_of(key)) is Literal and len(get_args(hint_of(key))) < 5:
        return "|".join(map(str, get_args(hint_of(key))))
    if key in keys_of(ExperimentConfig, "folder"):
        return "DIR"
    default = next(field.default for field in dataclasses.fields(owner) if field.name == name)
    if default is None:
        return "N"
    return str(default).lower() if isinstance(default, bool) else str(default)


def _words(key: str) -> str:
    if key in GROUPS:
        return f"{_CHOSEN[key]}: {', '.join(choices(key))}"
    return meaning(*_owner(key))


def meaning(owner: type, name: str) -> str:
    """What the docstring of a config class, or of the class it inherits from, says of a field."""
    for cls in owner.__mro__:
        text = inspect.cleandoc(cls.__doc__ or "")
        found = re.search(rf"^    (?:\w+, )*{name}(?:, \w+)*: (.*(?:\n {{8}}.*)*)", text, re.MULTILINE)
        if found:
            return " ".join(found[1].split()).rstrip(".")
    return ""


def _line(name: str, words: str) -> str:
    """A name and its words, wrapped in a second column."""
    first = f"  {name}".ljust(_COLUMN)
    wrapped = textwrap.wrap(words, WIDTH - _COLUMN, break_on_hyphens=False, break_long_words=False) or [""]
    rest = [" " * _COLUMN + line for line in wrapped]
    return "\n".join([first.rstrip(), *rest] if first[-1] != " " else [(first + wrapped[0]).rstrip(), *rest[1:]])
