"""Errors a user can act on.

Every message is one line: what was got, what was expected, what to do. The command line prints it and exits with 1.
"""

from __future__ import annotations

import errno
import os
from typing import Final

DEBUG: Final = "PLAYSLOT_DEBUG"
"""Environment variable; set to 1: errors show their traceback."""


class PlaySlotError(Exception):
    """Base of the errors that the command line shows without a traceback."""


class ConfigError(PlaySlotError, ValueError):
    """Unknown environment, preset or key, or a value outside its range."""


class DataError(PlaySlotError, ValueError):
    """A data set is missing, foreign, truncated, unfinalised, or has the wrong camera or frame size."""


class CheckpointError(PlaySlotError, ValueError):
    """A checkpoint is missing or damaged, has another parent, another config, or missing tensors."""


class TrainingError(PlaySlotError, RuntimeError):
    """Training cannot go on: the loss is not finite."""


class PeerError(TrainingError):
    """Another process of the same training ended; its own error says why."""


class OutputError(PlaySlotError, OSError):
    """The output folder holds something else, or cannot be written (full disk)."""


class RenderError(PlaySlotError, RuntimeError):
    """There is no working GL backend."""


class HubError(PlaySlotError, RuntimeError):
    """A push or pull failed: no or a bad token, no network, repository or revision, offline, or a server error."""


def require_type(given: object, what: str, *kinds: type, expected: str) -> None:
    """Refuse, by a TypeError of one line, an argument of another type; a bool is no number."""
    if not isinstance(given, kinds) or isinstance(given, bool):
        said = " ".join(repr(given).split())[:60]
        raise TypeError(f"{what}: got {said} ({type(given).__name__}), expected {expected}")


_SYSTEM: Final = {
    errno.ENOSPC: "got a full disk{}, expected free space: free some and run the same command again",
    errno.EDQUOT: "got a used-up disk quota{}, expected free space: free some and run the same command again",
    errno.EROFS: "got a read-only file system{}, expected one that can be written: choose another folder",
    errno.EACCES: "got no permission{}, expected it: change it or choose another folder",
    errno.ENFILE: "got too many open files{} on this machine, expected fewer: end other programs and run again",
    errno.EMFILE: "got too many open files{}, expected a higher limit: raise it (`ulimit -n 4096`) and run again",
}
"""What a user can act on, whichever library ran into it; the place goes into the braces."""


def first_line(error: BaseException) -> str:
    """The first line of what an error says; its kind where it says nothing."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]


def explain(error: BaseException) -> str:
    """One line about an error, the system's refusals first: libraries wrap them in errors of their own."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(error, PlaySlotError):
        for number, line in _SYSTEM.items():
            if (isinstance(cause, OSError) and cause.errno == number) or os.strerror(number) in str(cause):
                where = getattr(cause, "filename", None)
                return line.format(f" for {where}" if where else "")
        cause = cause.__cause__ or cause.__context__
    text = " ".join(str(error).split()) or "no message"
    if isinstance(error, PlaySlotError) or (isinstance(error, ValueError | TypeError) and _said_here(error, text)):
        return text
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError" or "allocate memory" in text:
        return f"got too little memory ({text}), expected enough for these sizes: choose smaller ones"
    if isinstance(error, OSError) and error.errno is not None and error.filename is not None:
        wanted = "expected a path that can be read and written: choose another, or mend this one"
        return f"got {type(error).__name__}: {text}, {wanted}"
    return f"{type(error).__name__}: {text} (unexpected; {DEBUG}=1 shows where)"


def _said_here(error: BaseException, text: str) -> bool:
    """Whether this package raised an error in its own words, for a user to act on."""
    where = error.__traceback__
    while where is not None and where.tb_next is not None:
        where = where.tb_next
    ours = where is not None and str(where.tb_frame.f_globals.get("__name__", "")).startswith("playslot_rl.")
    return ours and "got " in text and ", expected " in text
