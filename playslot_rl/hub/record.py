"""The small file that a push puts beside the data: what whoever pulls it has to find again."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from playslot_rl.errors import HubError
from playslot_rl.hub.checks import Content
from playslot_rl.hub.layout import LOCAL_RECORD, REMOTE_RECORD
from playslot_rl.storage.atomic import write_json

SCHEME = 1
"""Version of `datasets/fingerprint.py`, to be raised when that changes: those of another version are not compared."""


@dataclass(frozen=True)
class HubRecord:
    """What was pushed.

    Attributes:
        fingerprint: content hash of the data set, as `playslot dataset verify` prints it.
        episodes, frames: counts.
        scheme: how the fingerprint is made.
        playslot_rl: version that pushed.
    """

    fingerprint: str
    episodes: int
    frames: int
    scheme: int
    playslot_rl: str

    @classmethod
    def of(cls, content: Content) -> HubRecord:
        """The record of a checked data set."""
        from playslot_rl import __version__

        return cls(content.fingerprint, content.episodes, content.frames, SCHEME, __version__)

    def to_bytes(self) -> bytes:
        """As a file."""
        return (json.dumps(asdict(self), indent=2) + "\n").encode()


def read_record(root: Path) -> HubRecord | None:
    """The record of a pulled data set; None where it was pushed by something else.

    Raises:
        HubError: it is there and damaged.
    """
    path = root / REMOTE_RECORD
    if not path.is_file():
        return None
    try:
        return HubRecord(**json.loads(path.read_text()))
    except (ValueError, TypeError) as error:
        raise HubError(
            f"{REMOTE_RECORD}: got a damaged record ({type(error).__name__}), expected what `playslot dataset push` "
            "writes: ask its owner to push again"
        ) from error


def write_origin(root: Path, origin: dict[str, Any]) -> None:
    """Note where a pulled data set came from."""
    write_json(root / LOCAL_RECORD, origin)


def read_origin(root: Path) -> dict[str, Any]:
    """Where a data set was pulled from; empty if it was not, or if nobody can tell."""
    try:
        origin = json.loads((root / LOCAL_RECORD).read_text())
    except (OSError, ValueError):
        return {}
    return origin if isinstance(origin, dict) else {}
