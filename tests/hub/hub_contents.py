"""What the fake Hub holds: repositories, tokens, and faults to come."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field

WRITE_TOKEN = "hf_MARKERofTheOwner0123456789abcdef"
READ_TOKEN = "hf_MARKERofAReader0123456789abcdef"
PLAIN_TOKEN = "no.shape-that-tells-MARKER_it"
TOKENS = {WRITE_TOKEN: "owner", READ_TOKEN: "reader", PLAIN_TOKEN: "owner"}


@dataclass
class Repository:
    """Commits as whole trees; branches and tags by name."""

    name: str
    private: bool
    commits: dict[str, dict[str, bytes]] = field(default_factory=dict)
    history: list[tuple[str, str]] = field(default_factory=list)  # (branch, commit)
    branches: dict[str, str] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)

    def commit(self, branch: str, files: dict[str, bytes]) -> str:
        content = "".join(f"{path}{hashlib.sha1(data).hexdigest()}" for path, data in sorted(files.items()))
        commit = hashlib.sha1(f"{len(self.commits)}{content}".encode()).hexdigest()
        self.commits[commit] = files
        self.branches[branch] = commit
        self.history.append((branch, commit))
        return commit

    def resolve(self, revision: str) -> str | None:
        if revision in self.commits:
            return revision
        return self.branches.get(revision) or self.tags.get(revision)

    def files(self, revision: str = "main") -> dict[str, bytes]:
        commit = self.resolve(revision)
        assert commit is not None
        return self.commits[commit]


@dataclass
class Fault:
    """Something that goes wrong when the Hub answers.

    Attributes:
        method, pattern: which requests; the pattern is searched in the path.
        status: answer with this status; or
        cut: send so many bytes of the answer's body and close the connection; or
        corrupt: flip the last byte of the body.
        times: how often; -1 means always.
        echo: repeat the request's token in the error, as no Hub should.
        code: the Hub's name of the error.
        stall: wait until the Hub is told to go on, before answering.
    """

    method: str
    pattern: str
    status: int = 0
    cut: int = 0
    corrupt: bool = False
    times: int = 1
    echo: bool = False
    code: str = ""
    stall: bool = False
