"""A small Hugging Face Hub on localhost, for data sets and models, with faults on demand.

A model `owner/press` is the repository `models/owner/press` here.

It answers the requests that huggingface_hub 1.33 makes for a push and a pull: whoami, create, info, refs, tree,
validate-yaml, preupload, large files (batch, upload, verify), commit (ndjson), branch, tag, resolve with ranges.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import ThreadingHTTPServer

from hub_contents import PLAIN_TOKEN, READ_TOKEN, WRITE_TOKEN, Fault, Repository
from hub_requests import Handler

__all__ = ["PLAIN_TOKEN", "READ_TOKEN", "WRITE_TOKEN", "FakeHub", "Fault", "Repository"]


class FakeHub:
    """The server. `requests` lists what was asked: (method, path, headers, body)."""

    def __init__(self) -> None:
        self.repositories: dict[str, Repository] = {}
        self.large: dict[str, bytes] = {}
        self.faults: list[Fault] = []
        self.requests: list[tuple[str, str, dict[str, str], bytes]] = []
        self.lock = threading.RLock()
        self.stalled = threading.Event()
        self.go_on = threading.Event()
        hub = self

        class Answers(Handler):
            server_hub = hub

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Answers)
        self.server.daemon_threads = True
        self.url = f"http://127.0.0.1:{self.server.server_address[1]}"

    @contextmanager
    def running(self) -> Iterator[FakeHub]:
        thread = threading.Thread(target=self.server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)
        thread.start()
        try:
            yield self
        finally:
            self.server.shutdown()
            self.server.server_close()
            thread.join()

    def make(self, name: str, private: bool = False) -> Repository:
        repository = self.repositories[name] = Repository(name, private)
        repository.commit("main", {".gitattributes": b"*.parquet filter=lfs\n"})
        return repository

    def fault(self, method: str, path: str) -> Fault | None:
        with self.lock:
            for fault in self.faults:
                if fault.times and fault.method in (method, "*") and re.search(fault.pattern, path):
                    fault.times -= 1
                    return fault
        return None

    def asked(self, method: str, pattern: str) -> list[tuple[str, dict[str, str], bytes]]:
        return [(p, h, b) for m, p, h, b in self.requests if m == method and re.search(pattern, p)]
