"""What other packages bring: methods (entry points `playslot_rl.methods`) and tasks (`playslot_rl.envs`).

Nothing is imported before it is named. A package that cannot be imported is an error where its method or task is
named, and nowhere else.
"""

from __future__ import annotations

import functools
import importlib
from importlib.metadata import EntryPoint, entry_points
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


def call(reference: str, *arguments: Any, **named: Any) -> Any:
    module, _, function = reference.partition(":")
    return getattr(importlib.import_module(module), function)(*arguments, **named)
