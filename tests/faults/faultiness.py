"""What goes wrong in a child: it is killed at one of its writes, or writes fail.

Python announces what it does to a file system by an audit event before it does it. Counted is what happens below the
work folder: a file or folder is made (or opened to be written), renamed, or removed.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import resource
import signal
import sys
import threading
from pathlib import Path
from typing import Any

EVENTS = {"os.mkdir": "made", "os.rename": "renamed", "os.remove": "removed", "os.rmdir": "removed"}
FOLDERS = {"os.mkdir": 2, "os.rename": 2, "os.remove": 1, "os.rmdir": 1}
"""Which argument of an event is the open folder that a relative path begins at."""
WRITES = "writes.json"


class Faults:
    """Counts writes below a folder, and does what is asked at one of them.

    Args:
        root: the folder.
        asked: `kill=n` kills the process before its n-th write (from 0), `kill="end"` after the last; `fail=n, errno=e`
            lets whatever is made from the n-th write on fail; `descriptors=n` allows so many open files; `mortal=True`
            gives up root's right to write where permissions forbid it.
    """

    def __init__(self, root: Path, asked: dict[str, Any]) -> None:
        self.root, self.asked = str(root.resolve()) + os.sep, asked
        self.seen: list[tuple[str, str]] = []
        self._ended = False
        self._inside = threading.local()  # another thread's write hides none of this one's

    def begin(self) -> None:
        """Set everything up."""
        if not self.asked.get("slow_disk"):
            os.fsync = lambda _: None  # type: ignore[assignment]  # processes are killed here, never the machine
        _jobs_here()
        if "descriptors" in self.asked:
            resource.setrlimit(resource.RLIMIT_NOFILE, (self.asked["descriptors"],) * 2)
        if self.asked.get("mortal"):
            _give_up_capabilities()
        sys.addaudithook(self._hook)

    def end(self, place: Path, modules: list[str]) -> None:
        """The command has ended: say what it wrote and imported, or die before anybody hears that it has."""
        self._ended = True
        if not self.asked:
            (place / WRITES).write_text(json.dumps(self.seen))
            (place / "modules.json").write_text(json.dumps(modules))
        if self.asked.get("kill") == "end":
            os.kill(os.getpid(), signal.SIGKILL)

    def _hook(self, event: str, arguments: tuple[Any, ...]) -> None:
        kind = "made" if event == "open" and _to_write(*arguments[1:3]) else EVENTS.get(event)
        if kind is None or self._ended or getattr(self._inside, "hook", False):
            return
        self._inside.hook = True
        try:
            path = _path(event, arguments)
            if path.startswith(self.root):
                self._at(kind, path)
        finally:
            self._inside.hook = False

    def _at(self, kind: str, path: str) -> None:
        number = len(self.seen)
        if "/logs/" not in path:  # a thread of TensorBoard writes there in its own time
            self.seen.append((kind, path.removeprefix(self.root)))
            if number == self.asked.get("kill"):
                os.kill(os.getpid(), signal.SIGKILL)
        if kind == "made" and number >= self.asked.get("fail", sys.maxsize):
            raise OSError(self.asked["errno"], os.strerror(self.asked["errno"]), path)


def _to_write(mode: object, flags: object) -> bool:
    if isinstance(mode, str):
        return not set(mode).isdisjoint("wxa+")
    return isinstance(flags, int) and bool(flags & (os.O_CREAT | os.O_WRONLY | os.O_RDWR))


def _path(event: str, arguments: tuple[Any, ...]) -> str:
    if isinstance(arguments[0], int):
        return ""  # opened before
    path, place = os.fsdecode(arguments[0]), FOLDERS.get(event)
    if not Path(path).is_absolute():
        folder = arguments[place] if place is not None and len(arguments) > place else None
        base = f"/proc/self/fd/{folder}" if isinstance(folder, int) and folder >= 0 else "."
        path = str(Path(base).resolve() / path)
    return os.path.normpath(path)


def _jobs_here() -> None:
    """A comparison's jobs run in the process of its command, are killed with it, and need no imports of their own.
    What they say goes to a log otherwise: it is none of the command's lines.
    """
    from playslot_rl.recipes import compare_job
    from playslot_rl.studies import launch

    def run(file: Path) -> launch.Status:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            return compare_job.main(file)

    launch.run_process = run


def _give_up_capabilities() -> None:
    import ctypes

    libc = ctypes.CDLL(None, use_errno=True)
    version_3, none = (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()
    assert libc.capset(version_3, none) == 0, os.strerror(ctypes.get_errno())
