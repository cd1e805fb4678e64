"""A process that pushes and pulls for the tests: huggingface_hub reads its settings when it is imported.

Reads one JSON request a line, answers with one line. Sleeps are noted, not slept.
"""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import hashlib
import io
import json
import logging
import os
import shutil
import sys
import time
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any

RECORDS: list[str] = []
SLEPT: list[float] = []


class _Keep(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        RECORDS.append(self.format(record))


def _chain(error: BaseException | None) -> list[str]:
    texts: list[str] = []
    seen: set[int] = set()
    waiting = [error]
    while waiting:
        link = waiting.pop()
        if link is None or id(link) in seen:
            continue
        seen.add(id(link))
        texts += [str(link), repr(link), *getattr(link, "__notes__", ())]
        texts += [value for value in vars(link).values() if isinstance(value, str)]
        waiting += [link.__cause__, link.__context__]
    return texts


@contextlib.contextmanager
def _faults(patches: dict[str, Any]) -> Iterator[None]:
    """Named faults of this side."""
    import huggingface_hub.file_download as module

    http_get, disk_usage = module.http_get, shutil.disk_usage

    def full(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    if "full_disk" in patches:
        module.http_get = full
    if "free" in patches:
        usage = disk_usage(".")
        shutil.disk_usage = lambda _: usage._replace(free=patches["free"])  # type: ignore[assignment]
    try:
        yield
    finally:
        module.http_get, shutil.disk_usage = http_get, disk_usage


def _command(words: list[str]) -> int:
    from playslot_rl.cli import main as playslot

    with contextlib.redirect_stdout(sys.stderr):  # stdout carries the answers
        return playslot(words)


def _stream(root: str, cache: str) -> dict[str, Any]:
    from playslot_rl.data.source import open_sources

    with contextlib.redirect_stdout(io.StringIO()) as said:
        source = open_sources(root, cache=cache, buffer=1000)
        frames = source.frames[:]
    actions = None if source.actions is None else source.actions.tolist()
    return {
        "frames": hashlib.sha256(frames.tobytes()).hexdigest(), "shape": frames.shape, "actions": actions,
        "lengths": source.lengths.tolist(), "fingerprint": source.fingerprint, "said": said.getvalue(),
    }  # fmt: skip


def _run(request: dict[str, Any]) -> dict[str, Any]:
    from playslot_rl.hub.pull import pull, pull_policy
    from playslot_rl.hub.push import push, push_policy

    arguments = dict(request["arguments"])
    if request["call"] == "command":
        return {"status": _command(arguments["words"])}
    if request["call"] == "stream":
        return _stream(**arguments)
    for name in {"root", "folder"} & arguments.keys():
        arguments[name] = Path(arguments[name])
    if request["call"] == "pull_policy":
        return {"folder": str(pull_policy(**arguments))}
    result = {"push": push, "pull": pull, "push_policy": push_policy}[request["call"]](**arguments)
    return {"lines": result.lines(), "result": dataclasses.asdict(result)}


def main() -> None:
    logging.getLogger().addHandler(_Keep())
    logging.getLogger().setLevel(logging.DEBUG)
    import huggingface_hub

    huggingface_hub.logging.set_verbosity_debug()
    huggingface_hub.logging.enable_propagation()
    time.sleep = SLEPT.append  # type: ignore[assignment]
    for line in sys.stdin:
        request = json.loads(line)
        RECORDS.clear()
        SLEPT.clear()
        answer: dict[str, Any]
        try:
            with _faults(request["patches"]):
                answer = _run(request)
        except Exception as error:  # noqa: BLE001 - everything is reported to the test
            answer = {"error": str(error), "type": type(error).__name__, "chain": _chain(error),
                      "traceback": traceback.format_exc()}  # fmt: skip
        print(json.dumps(answer | {"logs": RECORDS, "slept": SLEPT}), flush=True)


if __name__ == "__main__":
    main()
