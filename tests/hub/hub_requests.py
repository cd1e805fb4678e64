"""How the fake Hub answers a request."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, unquote, urlsplit

from hub_contents import TOKENS, Repository

if TYPE_CHECKING:
    from fake_hub import FakeHub

LARGE = (".parquet", ".mp4", ".safetensors")


class RefusedError(Exception):
    def __init__(self, status: int, message: str, code: str = "", **content: str) -> None:
        super().__init__(message)
        self.status, self.message, self.code, self.content = status, message, code, content


Route = Callable[..., Any]
ROUTES: list[tuple[str, re.Pattern[str], str]] = [
    (method, re.compile(pattern + r"\Z"), name)
    for method, pattern, name in (
        ("GET", r"/api/whoami-v2", "whoami"),
        ("POST", r"/api/repos/create", "create"),
        ("POST", r"/api/validate-yaml", "validate"),
        ("GET", r"/api/((?:datasets|models)/[^/]+/[^/]+)", "info"),
        ("GET", r"/api/((?:datasets|models)/[^/]+/[^/]+)/revision/(.+)", "info"),
        ("GET", r"/api/((?:datasets|models)/[^/]+/[^/]+)/refs", "refs"),
        ("GET", r"/api/((?:datasets|models)/[^/]+/[^/]+)/tree/([^/]+)(?:/(.+))?", "tree"),
        ("POST", r"/api/((?:datasets|models)/[^/]+/[^/]+)/paths-info/([^/]+)", "paths"),
        ("POST", r"/api/((?:datasets|models)/[^/]+/[^/]+)/preupload/([^/]+)", "preupload"),
        ("POST", r"/api/((?:datasets|models)/[^/]+/[^/]+)/commit/([^/]+)", "commit"),
        ("POST", r"/api/((?:datasets|models)/[^/]+/[^/]+)/branch/([^/]+)", "branch"),
        ("POST", r"/api/((?:datasets|models)/[^/]+/[^/]+)/tag/([^/]+)", "tag"),
        ("DELETE", r"/api/((?:datasets|models)/[^/]+/[^/]+)/tag/([^/]+)", "untag"),
        ("POST", r"/((?:datasets/)?[^/]+/[^/]+)\.git/info/lfs/objects/batch", "batch"),
        ("PUT", r"/large/([0-9a-f]{64})", "upload"),
        ("POST", r"/large/([0-9a-f]{64})/verify", "verify"),
    )
]
RESOLVE = re.compile(r"/((?:datasets/)?[^/]+/[^/]+)/resolve/([^/]+)/(.+)\Z")


def named(place: str) -> str:
    """Name of the repository that an address means: those of models on the pages have no prefix."""
    if "/" not in place:
        return place  # a hash: it is no repository
    if place.startswith("datasets/"):
        return place.removeprefix("datasets/")
    return place if place.startswith("models/") else f"models/{place}"


def parts(matched: re.Match[str]) -> list[str]:
    """What an address names: the repository first."""
    groups = [unquote(group) for group in matched.groups() if group is not None]
    return [named(groups[0]), *groups[1:]] if groups else []


def blob_id(data: bytes) -> str:
    return hashlib.sha1(b"blob %d\0" % len(data) + data).hexdigest()


def is_large(path: str) -> bool:
    return path.endswith(LARGE)


class Handler(BaseHTTPRequestHandler):
    server_hub: FakeHub
    protocol_version = "HTTP/1.1"

    def log_message(self, *_: Any) -> None:
        pass

    def do_GET(self) -> None:
        self._answer()

    do_POST = do_PUT = do_DELETE = do_HEAD = do_GET  # noqa: N815

    def _answer(self) -> None:
        hub = self.server_hub
        path = unquote(urlsplit(self.path).path)
        self.body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        if "chunked" in self.headers.get("Transfer-Encoding", ""):
            self.body = self._chunks()
        with hub.lock:
            headers = {name.lower(): value for name, value in self.headers.items()}
            hub.requests.append((self.command, path, headers, self.body))
        self.failure = hub.fault(self.command, path)
        try:
            if self.failure and self.failure.stall:
                hub.stalled.set()
                hub.go_on.wait(60)
            if self.failure and self.failure.status:
                raise RefusedError(self.failure.status, "made to fail", self.failure.code)
            raw = urlsplit(self.path).path  # matched before it is unquoted: a branch's slash arrives as %2F
            matched = RESOLVE.match(raw)
            if matched and self.command in ("GET", "HEAD"):
                return self._file(*parts(matched))
            for method, pattern, name in ROUTES:
                matched = pattern.match(raw)
                if method == self.command and matched:
                    with hub.lock:
                        return self._json(200, getattr(self, f"_on_{name}")(*parts(matched)))
            raise RefusedError(404, f"no such route: {self.command} {path}")
        except RefusedError as refused:
            self._refuse(refused)

    def _chunks(self) -> bytes:
        body = b""
        while size := int(self.rfile.readline(), 16):
            body += self.rfile.read(size)
            self.rfile.readline()
        self.rfile.readline()
        return body

    def _refuse(self, refused: RefusedError) -> None:
        message = refused.message
        if self.failure and self.failure.echo:
            message += f": you sent {self.headers.get('Authorization')}"
        self._json(
            refused.status,
            {"error": message} | refused.content,
            {"X-Error-Message": message, "X-Error-Code": refused.code},
        )

    def _json(self, status: int, content: Any, headers: dict[str, str] | None = None) -> None:
        data = json.dumps(content).encode()
        self._send(status, data, {"Content-Type": "application/json", **(headers or {})})

    def _send(self, status: int, data: bytes, headers: dict[str, str]) -> None:
        self.send_response(status)
        for name, value in headers.items():
            if value:
                self.send_header(name, value)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        if self.command == "HEAD":
            return
        failure = self.failure
        if failure and failure.cut:
            self.wfile.write(data[: failure.cut])
            self.wfile.flush()
            self.close_connection = True
            self.connection.shutdown(2)
            return
        if failure and failure.corrupt:
            data = data[:-1] + bytes([data[-1] ^ 0xFF])
        self.wfile.write(data)

    # --- who and what -----------------------------------------------------------------------------------------------

    def _user(self, write: bool = False) -> str | None:
        header = self.headers.get("Authorization")
        if header is None:
            if write:
                raise RefusedError(401, "Invalid username or password.")
            return None
        user = TOKENS.get(header.removeprefix("Bearer "))
        if user is None:
            raise RefusedError(401, "Invalid credentials in Authorization header")
        if write and user == "reader":
            raise RefusedError(403, "You don't have the rights to do that")
        return user

    def _repository(self, name: str, write: bool = False) -> Repository:
        user = self._user(write)
        repository = self.server_hub.repositories.get(name)
        if repository is None or (repository.private and user != "owner"):
            raise RefusedError(401 if user is None else 404, "Repository not found", "RepoNotFound")
        return repository

    def _commit(self, repository: Repository, revision: str) -> str:
        commit = repository.resolve(revision)
        if commit is None:
            raise RefusedError(404, f"Invalid rev id: {revision}", "RevisionNotFound")
        return commit

    def _on_whoami(self) -> Any:
        return {"type": "user", "name": self._user(write=False) or self._user(write=True), "auth": {}}

    def _on_create(self) -> Any:
        self._user(write=True)
        asked = json.loads(self.body)
        kind = "datasets/" if asked.get("type") == "dataset" else ""
        name = named(f"{kind}{asked['organization']}/{asked['name']}")
        address = f"{self.server_hub.url}/{kind}{asked['organization']}/{asked['name']}"
        if name in self.server_hub.repositories:
            raise RefusedError(409, "You already created this repo", url=address)
        self.server_hub.make(name, private=asked.get("visibility") == "private")
        return {"url": address}

    def _on_validate(self) -> Any:
        import yaml

        header = json.loads(self.body)["content"].split("---")[1]
        try:
            yaml.safe_load(header)
        except yaml.YAMLError as error:
            raise RefusedError(400, str(error)) from error
        return {"errors": [], "warnings": []}

    def _on_info(self, name: str, revision: str = "main") -> Any:
        repository = self._repository(name)
        commit = self._commit(repository, revision)
        siblings = [{"rfilename": path} for path in sorted(repository.commits[commit])]
        return {"id": name, "sha": commit, "private": repository.private, "tags": [], "siblings": siblings}

    def _on_refs(self, name: str) -> Any:
        repository = self._repository(name)

        def listed(kind: str, refs: dict[str, str]) -> list[dict[str, str]]:
            return [{"name": n, "ref": f"refs/{kind}/{n}", "targetCommit": c} for n, c in refs.items()]

        return {"branches": listed("heads", repository.branches), "tags": listed("tags", repository.tags),
                "converts": []}  # fmt: skip

    def _on_tree(self, name: str, revision: str, folder: str = "") -> Any:
        repository = self._repository(name)
        files = repository.commits[self._commit(repository, revision)]
        deep = parse_qs(urlsplit(self.path).query).get("recursive", ["false"])[0].lower() == "true"
        folders = sorted({parent for path in files for parent in _parents(path)})
        entries: list[dict[str, Any]] = [{"type": "directory", "path": f, "size": 0, "oid": "0" * 40} for f in folders]
        entries += [_entry(path, data) for path, data in sorted(files.items())]
        below = f"{folder}/" if folder else ""
        return [e for e in entries if e["path"].startswith(below) and (deep or "/" not in e["path"][len(below) :])]

    def _on_paths(self, name: str, revision: str) -> Any:
        repository = self._repository(name)
        files = repository.commits[self._commit(repository, revision)]
        asked = json.loads(self.body)["paths"]
        return [_entry(path, files[path]) for path in ([asked] if isinstance(asked, str) else asked) if path in files]

    # --- writing ----------------------------------------------------------------------------------------------------

    def _on_preupload(self, name: str, revision: str) -> Any:
        repository = self._repository(name, write=True)
        files = repository.commits[self._commit(repository, revision)]

        def answer(path: str) -> dict[str, Any]:
            data = files.get(path)
            oid = None if data is None else hashlib.sha256(data).hexdigest() if is_large(path) else blob_id(data)
            mode = "lfs" if is_large(path) else "regular"
            return {"path": path, "uploadMode": mode, "shouldIgnore": False, "oid": oid}

        return {"files": [answer(file["path"]) for file in json.loads(self.body)["files"]]}

    def _on_batch(self, name: str) -> Any:
        self._repository(name, write=True)
        objects = []
        for item in json.loads(self.body)["objects"]:
            answer = {"oid": item["oid"], "size": item["size"]}
            if item["oid"] not in self.server_hub.large:
                url = f"{self.server_hub.url}/large/{item['oid']}"
                answer["actions"] = {"upload": {"href": url}, "verify": {"href": f"{url}/verify"}}
            objects.append(answer)
        return {"transfer": "basic", "objects": objects}

    def _on_upload(self, oid: str) -> Any:
        # Storage is signed by its address: a token that arrives here has leaked.
        if self.headers.get("Authorization"):
            raise RefusedError(400, "a token was sent to the storage")
        if hashlib.sha256(self.body).hexdigest() != oid:
            raise RefusedError(400, "content differs from its hash")
        self.server_hub.large[oid] = self.body
        return {}

    def _on_verify(self, oid: str) -> Any:
        if len(self.server_hub.large.get(oid, b"")) != json.loads(self.body)["size"]:
            raise RefusedError(400, "not uploaded")
        return {}

    def _on_commit(self, name: str, branch: str) -> Any:
        repository = self._repository(name, write=True)
        if branch not in repository.branches:
            raise RefusedError(404, f"Invalid rev id: {branch}", "RevisionNotFound")
        items = [json.loads(line) for line in self.body.splitlines()]
        header = items[0]["value"]
        if header.get("parentCommit") not in (None, repository.branches[branch]):
            raise RefusedError(412, "A commit has happened since. Please refresh and try again.")
        files = dict(repository.files(branch))
        for item in items[1:]:
            value, key = item["value"], item["key"]
            if key == "file":
                files[value["path"]] = base64.b64decode(value["content"])
            elif key == "lfsFile":
                files[value["path"]] = self.server_hub.large[value["oid"]]
            elif key == "deletedFile":
                del files[value["path"]]
            else:
                raise RefusedError(400, f"unknown operation {key}")
        commit = repository.commit(branch, files)
        page = name.removeprefix("models/") if name.startswith("models/") else f"datasets/{name}"
        return {"commitUrl": f"{self.server_hub.url}/{page}/commit/{commit}", "commitOid": commit}

    def _on_branch(self, name: str, branch: str) -> Any:
        repository = self._repository(name, write=True)
        if branch in repository.branches:
            raise RefusedError(409, "Reference already exists")
        start = json.loads(self.body or b"{}").get("startingPoint", "main")
        repository.branches[branch] = self._commit(repository, start)
        return {}

    def _on_tag(self, name: str, revision: str) -> Any:
        repository = self._repository(name, write=True)
        tag = json.loads(self.body)["tag"]
        if tag in repository.tags:
            raise RefusedError(409, "Tag reference exists already")
        repository.tags[tag] = self._commit(repository, revision)
        return {}

    def _on_untag(self, name: str, tag: str) -> Any:
        repository = self._repository(name, write=True)
        if repository.tags.pop(tag, None) is None:
            raise RefusedError(404, "no such tag", "RevisionNotFound")
        return {}

    # --- reading ----------------------------------------------------------------------------------------------------

    def _file(self, name: str, revision: str, path: str) -> None:
        repository = self._repository(name)
        commit = self._commit(repository, revision)
        data = repository.commits[commit].get(path)
        if data is None:
            raise RefusedError(404, "Entry not found", "EntryNotFound")
        etag = hashlib.sha256(data).hexdigest() if is_large(path) else blob_id(data)
        headers = {"ETag": f'"{etag}"', "X-Repo-Commit": commit, "Accept-Ranges": "bytes",
                   "Content-Type": "application/octet-stream"}  # fmt: skip
        wanted = re.fullmatch(r"bytes=(\d+)-(\d*)", self.headers.get("Range", ""))
        if wanted is None:
            return self._send(200, data, headers)
        begin = int(wanted[1])
        end = min(int(wanted[2] or len(data)), len(data) - 1)
        headers["Content-Range"] = f"bytes {begin}-{end}/{len(data)}"
        return self._send(206, data[begin : end + 1], headers)


def _parents(path: str) -> list[str]:
    parts = path.split("/")[:-1]
    return ["/".join(parts[: i + 1]) for i in range(len(parts))]


def _entry(path: str, data: bytes) -> dict[str, Any]:
    entry: dict[str, Any] = {"type": "file", "path": path, "size": len(data), "oid": blob_id(data)}
    if is_large(path):
        entry["lfs"] = {"oid": hashlib.sha256(data).hexdigest(), "size": len(data), "pointerSize": 130}
    return entry
