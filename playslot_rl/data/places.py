"""What is wrong with a data set, and where its files may lie: paths made from metadata stay below its folder.

LeRobot's own paths are `str.format` templates. A format can ask for a width of ten digits or for the attributes of what
it is given; here a template has the known fields only, and a path made from it has no way out of the folder.
"""

from __future__ import annotations

import codecs
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, TypeGuard

SHOWN: Final = 5  # messages of one kind before the rest is only counted
OUTSIDE: Final = "outside"  # kind of problem: a link out of the data set
CLUTTER: Final = "clutter"  # kind of warning: files of another file system that LeRobot takes for rows
FARTHEST: Final = 10**9  # the highest number of a folder or a file
_FIELD: Final = re.compile(r"\{(chunk_index|file_index|video_key)(?::0?(\d)d?)?\}")
_CLUTTER: Final = (".DS_Store", "Thumbs.db", "desktop.ini")
_LONGEST_PATH: Final = 1024
_LONGEST_NAME: Final = 255


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

    def excuse(self, kind: str) -> None:
        """Make warnings of all errors of a kind."""
        self._warnings.setdefault(kind, []).extend(self._errors.pop(kind, []))

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


def is_plain(name: str) -> bool:
    """Whether a text can be the name of one folder or file, here and on other systems."""
    printable = all(character.isprintable() and character not in "/\\" for character in name)
    return bool(name) and printable and name not in (".", "..") and len(name.encode()) <= _LONGEST_NAME


def is_plain_path(path: Any) -> TypeGuard[str]:
    """Whether this is a path with slashes that leads to a place below where it begins."""
    return isinstance(path, str) and len(path) <= _LONGEST_PATH and all(map(is_plain, path.split("/")))


def checked_template(template: Any, fields: tuple[str, ...]) -> bool:
    """Whether a template has `file_index` and `fields`, at most `chunk_index` too, and its paths stay below a root."""
    if not is_plain_path(template):
        return False
    found = {match[1] for match in _FIELD.finditer(template)}
    needed = {"file_index", *fields}
    return needed <= found <= needed | {"chunk_index"} and not set("{}") & set(_FIELD.sub("", template))


def filled(template: str, chunk: Any, file: Any, video_key: str = "") -> str | None:
    """The path of a checked template for numbers from metadata, or None where those are none."""
    numbers = {"chunk_index": chunk, "file_index": file}
    if not all(isinstance(n, int) and not isinstance(n, bool) and 0 <= n <= FARTHEST for n in numbers.values()):
        return None

    def value(match: re.Match[str]) -> str:
        return video_key if match[1] == "video_key" else str(numbers[match[1]]).zfill(int(match[2] or 0))

    return _FIELD.sub(value, template)


def inside(root: Path, path: Path) -> bool:
    """Whether a file lies below a data set's folder after all links are followed.

    A folder of huggingface_hub's cache counts as whole: its files are links to the blobs beside it.
    """
    base, target = Path(os.path.realpath(root)), Path(os.path.realpath(path))
    if target.is_relative_to(base):
        return True
    return base.parent.name == "snapshots" and target.is_relative_to(base.parent.parent / "blobs")


def is_clutter(path: Path) -> bool:
    """Whether a file is what another file system or file manager leaves beside others.

    Note: LeRobot takes `._file-000.parquet` for rows, and fails on it. One that is parquet is no clutter.
    """
    if path.name in _CLUTTER or not path.name.startswith("._"):
        return path.name in _CLUTTER
    return path.suffix != ".parquet" or not _begins(path, b"PAR1")


def _begins(path: Path, content: bytes) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(content)) == content


def parquet_files(root: Path, folder: str) -> list[Path]:
    """The files that LeRobot reads below `folder`, in order, but for clutter and links out of the data set."""
    found = sorted((root / folder).glob("*/*.parquet"))
    return [path for path in found if not is_clutter(path) and inside(root, path)]


def note_odd_files(root: Path, problems: Problems) -> None:
    """Note what lies in a data set's folders and is not of it: links out of it, clutter, rows where none are read."""
    for path in _files(root):
        if path.is_symlink() and not inside(root, path):
            problems.error(
                OUTSIDE, f"{path}: got a link out of the data set, expected a file of its own: copy it there"
            )
        elif is_clutter(path):
            kind, fails = (CLUTTER, " here, though LeRobot fails on it") if path.suffix == ".parquet" else ("views", "")
            problems.warning(kind, f"{path}: got a file of another file system, passed over{fails}: delete it")
        elif path.suffix == ".json" and _begins(path, codecs.BOM_UTF8):
            problems.warning("mark", f"{path}: got a byte-order mark, on which LeRobot fails: save it without one")
        elif path.suffix == ".parquet" and not path.is_dir():
            place = path.relative_to(root).parts
            if (place[0] == "data" and len(place) != 3) or (place[:2] == ("meta", "episodes") and len(place) != 4):
                problems.error(
                    "stale shard",
                    f"{path}: got a parquet file that no reader looks for, expected none: it is left from another "
                    "version, or foreign",
                )


def _files(root: Path) -> Iterator[Path]:
    for name in ("meta", "data", "videos"):
        if (root / name).is_symlink():
            yield root / name
        for folder, folders, files in os.walk(root / name):
            yield from (Path(folder) / entry for entry in sorted(files))
            yield from (Path(folder) / entry for entry in sorted(folders) if (Path(folder) / entry).is_symlink())
