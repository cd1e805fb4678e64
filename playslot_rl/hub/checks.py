"""What is checked of a data set before it leaves and after it arrives."""

from __future__ import annotations

import hashlib
from pathlib import Path

from playslot_rl.data.lerobot_files import LeRobotFiles, open_files
from playslot_rl.hub.layout import LOCAL_RECORD, REMOTE_RECORD, is_data

_PIECE = 8 << 20


def check_data_set(root: Path) -> LeRobotFiles:
    """Open a data set and compare its counts with its metadata.

    Raises:
        DataError: missing, of another format version, unfinalised, or with more or fewer rows than its metadata says.
    """
    return open_files(root)


def fingerprint(root: Path) -> str:
    """Content hash of every file of a data set except the Hub's records: 16 hex digits."""
    digest = hashlib.sha256()
    for file in sorted(root.rglob("*")):
        path = file.relative_to(root).as_posix()
        if not is_data(path) or path in (LOCAL_RECORD, REMOTE_RECORD) or not file.is_file():
            continue
        digest.update(f"{path}\0{file.stat().st_size}\0".encode())
        with file.open("rb") as stream:
            while piece := stream.read(_PIECE):
                digest.update(piece)
    return digest.hexdigest()[:16]
