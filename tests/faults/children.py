"""A process that has imported much and runs `playslot` commands in forks of itself, with faults of the disk.

Importing takes ten seconds, a fork none; and a fork can be killed at any write. The server has one thread and computes
nothing itself. What a first fork had to import, the server imports before the next. One JSON line each way.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import subprocess
import sys
import traceback
from dataclasses import dataclass
from multiprocessing import util
from pathlib import Path
from typing import Any

KILLED = -9
MODULES = "modules.json"


@dataclass(frozen=True)
class Ended:
    """How a command ended: exit code (`KILLED` of one that was), and what it said."""

    code: int
    out: str
    err: str


class Children:
    """The client's side.

    Args:
        folder: where children leave what they say.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self._number, self._asked = folder, 0, 0
        # A thread of jemalloc, which Arrow brings, is in the way of a fork.
        own = {"OMP_NUM_THREADS": "1", "JE_ARROW_MALLOC_CONF": "background_thread:false", "HF_HUB_OFFLINE": "1"}
        self.process = subprocess.Popen(
            [sys.executable, __file__], env=os.environ | own, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def start(self, root: Path, *argv: str, **fault: Any) -> Child:
        """Begin a command in the folder `root`; see `faultiness` for faults."""
        self._number += 1
        place = self.folder / f"{self._number:04d}"
        place.mkdir()
        asked = {"argv": argv, "root": str(root), "place": str(place), "fault": fault}
        return Child(self, int(self.ask(asked)["pid"]), place)

    def run(self, root: Path, *argv: str, **fault: Any) -> Ended:
        """Run a command in the folder `root` to its end."""
        return self.start(root, *argv, **fault).wait()

    def ask(self, asked: dict[str, Any]) -> dict[str, Any]:
        """One request, one answer; those of a test that ran out of time are passed over."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self._asked += 1
        self.process.stdin.write(json.dumps(asked | {"number": self._asked}) + "\n")
        self.process.stdin.flush()
        answer: dict[str, Any] = {}
        while answer.get("number") != self._asked:
            answer = json.loads(self.process.stdout.readline())
        return answer

    def close(self) -> None:
        """End the server."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.kill()
        self.process.wait()


@dataclass(frozen=True)
class Child:
    """A command that runs."""

    children: Children
    pid: int
    place: Path

    def wait(self) -> Ended:
        """Wait for its end."""
        code = int(self.children.ask({"wait": self.pid})["code"])
        modules = self.place / MODULES
        if modules.is_file():
            self.children.ask({"import": json.loads(modules.read_text())})
        return Ended(code, (self.place / "out").read_text(), (self.place / "err").read_text())


def main() -> None:
    """Fork a child for each request, wait for one, or import what one had to import."""
    for line in sys.stdin:
        asked = json.loads(line)
        if "import" in asked:
            for name in asked["import"]:
                if name not in sys.modules:
                    with contextlib.suppress(Exception):  # a part of another module that it makes itself
                        importlib.import_module(name)
            assert len(list(Path("/proc/self/task").iterdir())) == 1, "a fork of a process with threads may hang"
            answer = {}
        elif "wait" in asked:
            answer = {"code": os.waitstatus_to_exitcode(os.waitpid(asked["wait"], 0)[1])}
        else:
            child = os.fork()
            if not child:
                _run(asked)
            answer = {"pid": child}
        print(json.dumps(answer | {"number": asked["number"]}), flush=True)


def _run(asked: dict[str, Any]) -> None:
    """The child: never returns."""
    root, place, code = Path(asked["root"]), Path(asked["place"]), 99
    try:
        os.setsid()
        for number, name in enumerate((os.devnull, place / "out", place / "err")):
            opened = os.open(name, os.O_RDWR | os.O_CREAT)
            os.dup2(opened, number)
            os.close(opened)
        os.chdir(root)
        os.environ["PLAYSLOT_CACHE"] = str(root / "cache")
        from playslot_rl import cli
        from playslot_rl.envs.rendering import import_mujoco

        import_mujoco()  # before torchrl
        known = set(sys.modules)
        import faultiness

        faults = faultiness.Faults(root, asked["fault"])
        faults.begin()
        try:
            code = cli.main(asked["argv"])
        except SystemExit as ended:
            code = int(ended.code or 0)
        faults.end(place, [name for name in sys.modules if name not in known])
    except BaseException:  # noqa: BLE001  a traceback is what the tests look for
        traceback.print_exc()
    finally:
        util._exit_function()  # semaphores that libraries made
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


if __name__ == "__main__":
    main()
