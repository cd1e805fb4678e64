"""Errors a user can act on.

Every message is one line: what was got, what was expected, what to do. The command line prints it and exits with 1.
"""

from __future__ import annotations


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


class OutputError(PlaySlotError, OSError):
    """The output folder holds something else, or cannot be written (full disk)."""


class RenderError(PlaySlotError, RuntimeError):
    """There is no working GL backend."""


class HubError(PlaySlotError, RuntimeError):
    """A push or pull failed: no or a bad token, no network, repository or revision, offline, or a server error."""
