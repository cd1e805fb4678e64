"""Amounts of memory and disk in words: `20GB`."""

from __future__ import annotations

from typing import Final

UNITS: Final = {"kb": 10**3, "mb": 10**6, "gb": 10**9, "tb": 10**12}
BINARY: Final = {"kib": 2**10, "mib": 2**20, "gib": 2**30, "tib": 2**40}


def bytes_of(text: str) -> int | None:
    """Bytes; None for an empty text, a ValueError for no such amount.

    Examples:
        >>> bytes_of("20GB"), bytes_of("1.5 GiB"), bytes_of("")
        (20000000000, 1610612736, None)
    """
    words = text.strip().lower()
    if not words:
        return None
    number = words.rstrip("abcdefghijklmnopqrstuvwxyz")
    unit = words[len(number) :]
    factor = {"": 1, "b": 1, **UNITS, **BINARY}.get(unit)
    amount = float(number) * factor if factor else -1.0  # float says what is no number
    if not 0 < amount < 2**63:
        raise ValueError(f"got {text}, expected an amount such as 500MB or 20GB")
    return int(amount)


def is_amount(text: str) -> bool:
    """Whether `bytes_of` takes it."""
    try:
        bytes_of(text)
    except ValueError:
        return False
    return True


def shown(count: float) -> str:
    """Bytes for people, three digits.

    Examples:
        >>> shown(999), shown(12_345_678)
        ('999 B', '12.3 MB')
    """
    for unit, factor in reversed(UNITS.items()):
        if count >= factor:
            return f"{count / factor:.3g} {unit.upper()}"
    return f"{count:.0f} B"
