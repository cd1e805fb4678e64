"""The small file that a push puts beside the data: what whoever pulls it has to find again."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

from playslot_rl import __version__
from playslot_rl.errors import HubError
from playslot_rl.hub.layout import REMOTE_RECORD

SCHEME = 1
"""Version of `datasets/fingerprint.py`, to be raised when that changes: those of another version are not compared."""


@dataclass(frozen=True)
class HubRecord:
    """What was pushed; equal to another record of the same content.

    Attributes:
        fingerprint: content hash of the data set, as `playslot dataset verify` prints it.
        episodes, frames: counts.
        scheme: how the fingerprint is made.
        playslot_rl: version that pushed.
    """

    fingerprint: str
    episodes: int
    frames: int
    scheme: int = field(compare=False)
    playslot_rl: str = field(compare=False)

    @classmethod
    def of(cls, fingerprint: str, episodes: int, frames: int) -> HubRecord:
        """The record of a checked data set, made by this version."""
        return cls(fingerprint, episodes, frames, SCHEME, __version__)

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
