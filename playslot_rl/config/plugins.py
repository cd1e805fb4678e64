"""What other packages bring: methods (entry points `playslot_rl.methods`) and tasks (`playslot_rl.envs`).

Nothing is imported before it is named. A package that cannot be imported is an error where its method or task is
named, and nowhere else.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Iterator, Mapping
from importlib.metadata import EntryPoint, entry_points
from types import MappingProxyType
from typing import Any

from playslot_rl.errors import ConfigError


@functools.cache
def brought(group: str) -> dict[str, EntryPoint]:
    """Entry points of a group by name."""
    return {entry.name: entry for entry in entry_points(group=group)}


@functools.cache
def load(group: str, name: str, kind: type, built_in: str = "") -> Any:
    """The object, of a `kind`, that a name stands for: `module:object` of a built-in, or an entry point of a package; a
    ConfigError, which names the package, where it cannot be loaded or is something else.
    """
    if built_in:
        module, _, attribute = built_in.partition(":")
        return getattr(importlib.import_module(module), attribute)
    entry = brought(group)[name]
    package = entry.dist.name if entry.dist else entry.value
    cure = f"repair the package {package}, or uninstall it"
    try:
        found = entry.load()
    except Exception as error:  # whatever a foreign package does when it is imported
        what = f"{type(error).__name__}: {error}".splitlines()[0]
        raise ConfigError(
            f"{name}: got {entry.value} of the package {package}, which fails ({what}): {cure}"
        ) from error
    if not isinstance(found, kind) or getattr(found, "name", None) != name:
        raise ConfigError(
            f"{name}: got {entry.value} of the package {package}, expected a {kind.__name__} of the name {name}: {cure}"
        )
    return found


class Registry[Kind](Mapping[str, Kind]):
    """What entry points of a group give, and our own as `module:object`, by name: imported when they are asked for.
    Those of packages that cannot be imported are left out of the list.
    """

    def __init__(self, group: str, kind: type[Kind], ours: Mapping[str, str] = MappingProxyType({})) -> None:
        self.group, self.ours = group, ours
        self.kind: type = kind

    def __getitem__(self, name: str) -> Kind:
        if name not in self.ours and name not in brought(self.group):
            raise KeyError(name)
        found: Kind = load(self.group, name, self.kind, self.ours.get(name, ""))
        return found

    def __iter__(self) -> Iterator[str]:
        yield from self.ours
        for name in brought(self.group).keys() - self.ours.keys():
            try:
                self[name]
            except ConfigError:  # said where it is named
                continue
            yield name

    def __len__(self) -> int:
        return sum(1 for _ in self)


def call(reference: str, *arguments: Any, **named: Any) -> Any:
    module, _, function = reference.partition(":")
    return getattr(importlib.import_module(module), function)(*arguments, **named)
