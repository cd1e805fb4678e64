"""Collecting what is wrong with a data set: all of it, but not the same thing a thousand times."""

from __future__ import annotations

SHOWN = 5  # messages of one kind before the rest is only counted


class Problems:
    """Errors and warnings by kind, in the order the kinds first appeared."""

    def __init__(self) -> None:
        self._errors: dict[str, list[str]] = {}
        self._warnings: dict[str, list[str]] = {}

    def error(self, kind: str, message: str) -> None:
        """The data set is not what it says it is."""
        self._errors.setdefault(kind, []).append(message)

    def warning(self, kind: str, message: str) -> None:
        """Untidy, but every frame and number can be trusted."""
        self._warnings.setdefault(kind, []).append(message)

    def of(self, kind: str) -> list[str]:
        return self._errors.get(kind, [])

    def warnings_of(self, kind: str) -> list[str]:
        return self._warnings.get(kind, [])

    @property
    def errors(self) -> list[str]:
        return _lines(self._errors)

    @property
    def warnings(self) -> list[str]:
        return _lines(self._warnings)


def _lines(found: dict[str, list[str]]) -> list[str]:
    lines: list[str] = []
    for kind, messages in found.items():
        lines += messages[:SHOWN]
        if len(messages) > SHOWN:
            lines.append(f"{kind}: and {len(messages) - SHOWN} more of this kind")
    return lines
