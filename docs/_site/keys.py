"""Writes docs/reference/keys.md, every key of the config with its default and its meaning, from the config's classes:

    .venv/bin/python docs/_site/keys.py

A test holds the page against what this makes.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Iterator
from operator import attrgetter
from pathlib import Path
from typing import Any, Final, Literal, get_args, get_origin

from playslot_rl.config import ExperimentConfig, key_help
from playslot_rl.config.compose import GROUPS, choices, compose
from playslot_rl.config.methods import METHODS

PAGE: Final = Path(__file__).resolve().parents[1] / "reference" / "keys.md"
INTRODUCTION: Final = """\
# Keys

Every key of the config, made from its classes by `.venv/bin/python docs/_site/keys.py`. Type it as `group.key=value`.
The default is the class's, which is the paper's size; the column `compact` has what ButtonPress's `preset=compact`, the
preset of a command that names none, changes.

`compare`, `compare-video` and `plan` take keys of their own group without its name: `methods=`, `seeds=`, `planner=`.

| key | chooses | names |
|---|---|---|
| `env` | the task | ENVS |
| `preset` | sizes and schedule | PRESETS |
| `method` | what is trained and compared | NAMES |
"""


def sections() -> dict[type, list[str]]:
    """Each class of the config that has keys of its own, with the groups that have them; a base class comes first."""
    found: dict[type, list[str]] = {}

    def walk(cls: type, group: str) -> None:
        for base in reversed(cls.__mro__):
            if own(base):
                found.setdefault(base, []).append(group)
        for name, hint in key_help.fields_of(cls).items():
            if dataclasses.is_dataclass(hint):
                walk(hint, f"{group}{name}.")

    walk(ExperimentConfig, "")
    return found


def own(cls: type) -> dict[str, dataclasses.Field[Any]]:
    """The keys that a class adds to those of its base."""
    if not dataclasses.is_dataclass(cls):
        return {}
    bases = [base for base in cls.__mro__[1:] if dataclasses.is_dataclass(base)]
    inherited, hints = {field.name for base in bases for field in dataclasses.fields(base)}, key_help.fields_of(cls)
    fields = [field for field in dataclasses.fields(cls) if field.name not in inherited]
    return {field.name: field for field in fields if not dataclasses.is_dataclass(hints[field.name])}


def rows(cls: type, groups: list[str], compact: Any) -> Iterator[str]:
    """The table of a class: a row a key; with what `compact` changes, where it is one group's and changes something."""
    fields = [field for field in own(cls).values() if groups[0] + field.name not in GROUPS]
    changed = {}
    if len(groups) == 1:
        here = {field.name: shown(attrgetter(groups[0] + field.name)(compact)) for field in fields}
        changed = {field.name: here[field.name] for field in fields if here[field.name] != shown(field.default)}
    yield "| key | default | `compact` | meaning |" if changed else "| key | default | meaning |"
    yield "|---|---|---|---|" if changed else "|---|---|---|"
    for field in fields:
        cells = [f"`{field.name}`", shown(field.default), *([changed.get(field.name, "")] if changed else [])]
        yield "| " + " | ".join([*cells, explained(cls, field.name)]) + " |"


def explained(cls: type, name: str) -> str:
    """The meaning of a key, with the values it takes where the words do not name them."""
    hint, words = key_help.fields_of(cls)[name], key_help.meaning(cls, name).replace("|", "\\|")
    if get_origin(hint) is Literal and not all(f"`{choice}`" in words for choice in get_args(hint)):
        words += " (" + ", ".join(f"`{choice}`" for choice in get_args(hint)) + ")"
    return words


def heading(groups: list[str]) -> str:
    """Of a section: its groups, or the first of many, with all of them below."""
    names = [f"`{group.removesuffix('.')}`" for group in groups]
    if names == ["``"]:
        return "Without a group"
    if len(names) < 4:
        return ", ".join(names)
    return f"{names[0]} and {len(names) - 1} more\n\nIn {', '.join(names)}."


def shown(default: Any) -> str:
    """A value as it is typed."""
    if default is None or default in ("", ()):
        return "–"
    if isinstance(default, bool):
        return str(default).lower()
    if isinstance(default, tuple):
        return ",".join(map(str, default))
    return str(default)


def page() -> str:
    """The whole page."""
    compact = compose(["preset=compact"])
    names = {"ENVS": choices("env"), "PRESETS": choices("preset"), "NAMES": METHODS}
    text = INTRODUCTION
    for word, known in names.items():
        text = text.replace(word, ", ".join(f"`{name}`" for name in known))
    for cls, groups in sections().items():
        first = (inspect.getdoc(cls) or "").split("\n\n")[0].replace("\n", " ")
        text += f"\n## {heading(groups)}\n\n{first}\n\n" + "\n".join(rows(cls, groups, compact)) + "\n"
    return text


def main() -> None:
    """Write it."""
    PAGE.parent.mkdir(exist_ok=True)
    PAGE.write_text(page())
    print("docs/reference/keys.md")


if __name__ == "__main__":
    main()
