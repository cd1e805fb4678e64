"""What no `key=value` argument may hold, whatever its key: refused before anything reads it."""

from __future__ import annotations

import dataclasses
import os
import re
import types
from collections.abc import Sequence
from typing import Any, Final, Union, get_args, get_origin

from playslot_rl.errors import ConfigError

NAME_BYTES: Final = 255
PATH_BYTES: Final = 4095
LONGEST_NUMBER: Final = 1000

_INTERPOLATION: Final = re.compile(r"\$\\*\{")
_RESOLVER: Final = re.compile(r"\$\\*\{[^}]*:")
_GROUPED: Final = re.compile(r"[+-]?\d[\d_]*_\d[\d_]*(\.\d*)?([eE][+-]?\d+)?")
_HIDDEN: Final = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")


def require_plain(key: str, argument: str) -> None:
    """Refuse interpolation, which could bring an environment variable into a message, and characters that nobody sees.

    Examples:
        >>> require_plain("out", "out=runs/$HOME")
        >>> require_plain("seed", "seed=${oc.env:TOKEN}")
        Traceback (most recent call last):
        playslot_rl.errors.ConfigError: seed: got an interpolation (${...}), expected the value itself: nothing ...
    """
    if _HIDDEN.search(argument):
        raise ConfigError(
            f"{_HIDDEN.sub('?', key)}: got a line break, a control character or no valid text, expected plain text"
        )
    # Hydra's own keys, which go to it as they are, may name one another, but nothing from elsewhere.
    pattern = _RESOLVER if key.startswith("hydra.") else _INTERPOLATION
    if pattern.search(argument):
        name = "an argument" if "{" in key else key
        raise ConfigError(
            f"{name}: got an interpolation (${{...}}), expected the value itself: nothing is looked up in the "
            "environment or in other keys"
        )


def require_once(keys: Sequence[str]) -> None:
    """Refuse a key that was typed twice."""
    for key in keys:
        if keys.count(key) > 1:
            raise ConfigError(f"{key}: got it {keys.count(key)} times, expected it once: leave the others out")


def require_digits(key: str, value: str, hint: Any) -> None:
    """Refuse `1_000` for a number, which is read as 1000 in one place and as text in another, and what Python reads as
    no number for its length.
    """
    for part in re.split(r"[\[\]{}():,\s]+", value) if _numeric(hint) else ():
        if _GROUPED.fullmatch(part):
            raise ConfigError(f"{key}: got {part}, expected digits without _, such as {part.replace('_', '')}")
        if len(part) > LONGEST_NUMBER:
            raise ConfigError(f"{key}: got {len(part)} characters, expected a number of at most {LONGEST_NUMBER}")


def require_folders(key: str, value: str) -> None:
    """Refuse paths, one or several with commas, that no file system takes, and a list where one folder is meant."""
    if key in ("out", "run") and value.startswith("[") and value.endswith("]"):
        raise ConfigError(f"{key}: got the list {value}, expected one folder, such as {key}=runs/first")
    for folder in value.split(","):
        longest, whole = max(len(os.fsencode(name)) for name in folder.split("/")), len(os.fsencode(folder))
        if longest > NAME_BYTES or whole > PATH_BYTES:
            raise ConfigError(
                f"{key}: got a name of {longest} bytes in a path of {whole}, expected at most {NAME_BYTES} and "
                f"{PATH_BYTES}: choose a shorter one"
            )


def _numeric(hint: Any) -> bool:
    if get_origin(hint) in (Union, types.UnionType, tuple):
        return any(map(_numeric, get_args(hint)))
    return hint in (int, float) or dataclasses.is_dataclass(hint)
