"""What is checked of a data set before it leaves and after it arrives."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from playslot_rl.data.contents import read_contents
from playslot_rl.data.problems import Problems
from playslot_rl.datasets.fingerprint import fingerprint_of
from playslot_rl.datasets.frames import scan_frames
from playslot_rl.datasets.rows import check_rows
from playslot_rl.datasets.verify import verify
from playslot_rl.errors import DataError


@dataclass(frozen=True)
class Content:
    """What a sound data set holds.

    Attributes:
        episodes, frames: counts.
        fingerprint: of the content, as `playslot dataset verify` prints it.
    """

    episodes: int
    frames: int
    fingerprint: str


def check_before_push(root: Path) -> Content:
    """Everything `playslot dataset verify` checks: others will build on it.

    Raises:
        DataError: it is not sound.
    """
    result = verify(root)
    if not result.ok:
        more = f" (and {len(result.errors) - 1} more)" if len(result.errors) > 1 else ""
        raise DataError(f"{result.errors[0]}{more}; run `playslot dataset verify {root}` for all of it, then `repair`")
    return Content(result.episodes, result.frames, result.fingerprint)


def check_after_pull(root: Path) -> Content:
    """Counts, indices and every frame. Statistics are not compared: others' may be made in another way.

    Raises:
        DataError: rows and metadata disagree, or frames cannot be decoded; the message is the first fault.
    """
    problems = Problems()
    contents = read_contents(root, problems)
    check_rows(contents, problems)
    scans = scan_frames(contents, problems)
    if problems.errors:
        raise DataError(problems.errors[0])
    return Content(len(contents.spans), contents.rows, fingerprint_of(contents, scans).value)
