"""A process that pushes and pulls for the tests: huggingface_hub reads its settings when it is imported.

Reads one JSON request a line, answers with one line. Sleeps are noted, not slept.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import sys
import time
import traceback
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
        texts += [str(link), repr(link), repr(vars(link)), *getattr(link, "__notes__", ())]
        waiting += [link.__cause__, link.__context__]
    return texts


def _patch(name: str, value: Any) -> None:
    """Named faults of this side."""
    if name == "full_disk":
        import huggingface_hub.file_download as module

        def full(*_: Any, **__: Any) -> None:
            raise OSError(28, "No space left on device")

        module.http_get = full
    elif name == "free":
        import collections
        import shutil

        usage = collections.namedtuple("usage", "total used free")
        shutil.disk_usage = lambda _: usage(10**9, 10**9 - value, value)  # type: ignore[assignment]
    else:
        raise ValueError(name)


def _run(request: dict[str, Any]) -> dict[str, Any]:
    from playslot_rl.hub.pull import pull
    from playslot_rl.hub.push import push

    arguments = dict(request["arguments"])
    arguments["root"] = Path(arguments["root"])
    result = {"push": push, "pull": pull}[request["call"]](**arguments)
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
            for name, value in request.get("patches", {}).items():
                _patch(name, value)
            answer = _run(request)
        except Exception as error:  # noqa: BLE001 - everything is reported to the test
            answer = {"error": str(error), "type": type(error).__name__, "chain": _chain(error),
                      "traceback": traceback.format_exc()}  # fmt: skip
        print(json.dumps(answer | {"logs": RECORDS, "slept": SLEPT}), flush=True)


if __name__ == "__main__":
    main()
