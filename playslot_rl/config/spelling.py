"""Values as they are typed after `key=`."""

from __future__ import annotations

from typing import Any


def quoted(text: str) -> str:
    """Text as Hydra's grammar reads it back unchanged."""
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"


def typed_value(value: Any) -> str:
    """A plain value: a number, text, a flag, nothing, or a list of these.

    Examples:
        >>> typed_value(True), typed_value(None), typed_value([1, "a,b"])
        ('true', 'null', "[1,'a,b']")
    """
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return "[" + ",".join(quoted(part) if isinstance(part, str) else typed_value(part) for part in value) + "]"
    return str(value)
