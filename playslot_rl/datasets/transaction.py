"""A new data set is written under a temporary name, verified, and only then given its name."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

from playslot_rl.datasets.verify import Verification, verify
from playslot_rl.errors import DataError, OutputError
from playslot_rl.storage.atomic import explain_write_errors, replace_dir


def require_free(out: Path) -> None:
    """Refuse to write over something.

    Raises:
        OutputError: `out` exists and is not an empty folder.
    """
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise OutputError(f"{out}: got a folder or file that exists, expected none; choose another --out")


@contextlib.contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """Gives a temporary path beside `out`, renamed to `out` at the end; after an error or a kill there is no `out`.

    Raises:
        OutputError: `out` holds something, or the disk is full.
    """
    out = out.absolute()
    require_free(out)
    temporary = out.with_name(f".{out.name}.new")
    with explain_write_errors(out):
        out.parent.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(temporary, ignore_errors=True)  # of a command that was killed
        try:
            yield temporary
            if out.is_dir():
                out.rmdir()
            replace_dir(temporary, out)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


def require_verified(root: Path, sources: Sequence[Path]) -> Verification:
    """Verify a data set that has just been written.

    Raises:
        DataError: it is not sound; then a source was damaged in its frames or statistics.
    """
    result = verify(root)
    if not result.ok:
        names = " ".join(map(str, sources))
        reason = result.errors[0].replace(f"{root}/", "")
        raise DataError(
            f"{names}: the data set made from it is not sound ({reason}), expected sound episodes; nothing was "
            "written: run `playslot dataset verify` and `playslot dataset repair` on it first"
        )
    return result
