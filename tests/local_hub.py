"""
A stand-in for the Hub on this machine: as much of its HTTP interface as it takes to share a model and to fetch it.

Run as a script it prints its address and serves until it is ended.
"""

import base64
import hashlib
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, NamedTuple
from urllib.parse import unquote, urlsplit

BINARY = (".zip", ".mp4", ".npz")


class Request(NamedTuple):
    """What was asked, and with which token."""

    method: str
    path: str
    authorization: str | None


class LocalHub(ThreadingHTTPServer):
    """
    Repositories in memory.

    ``files`` holds their content by repository and name, ``requests`` all that was asked.

    :param token: without which nothing may be written
    """

    def __init__(self, token: str = "") -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.token = token
        self.files: dict[str, dict[str, bytes]] = {}
        self.large: dict[str, bytes] = {}
        self.requests: list[Request] = []

    @property
    def url(self) -> str:
        """Address to give to the Hub's client as its endpoint."""
        return f"http://127.0.0.1:{self.server_port}"

    def commit(self, repository: str) -> str:
        """Hash of the present content of a repository."""
        content = sorted(self.files[repository].items())
        return hashlib.sha1(repr([(name, _sha256(data)) for name, data in content]).encode()).hexdigest()


@contextmanager
def serving(token: str = "") -> Iterator[LocalHub]:
    """A hub that serves meanwhile."""
    with LocalHub(token) as hub:
        threading.Thread(target=hub.serve_forever, daemon=True).start()
        yield hub
        hub.shutdown()


class _Handler(BaseHTTPRequestHandler):
    server: LocalHub
    protocol_version = "HTTP/1.1"

    def do_POST(self) -> None:
        path, body = self._note(), self._body()
        if not self._may_write():
            self._answer({"error": "Invalid credentials in Authorization header"}, 401)
        elif path == "/api/repos/create":
            wanted = json.loads(body)
            repository = f"{wanted['organization']}/{wanted['name']}"
            self.server.files.setdefault(repository, {})
            self._answer({"url": f"{self.server.url}/{repository}"})
        elif path == "/api/validate-yaml":
            self._answer({"errors": [], "warnings": []})
        elif "/preupload/" in path:
            names = [file["path"] for file in json.loads(body)["files"]]
            modes = [{"path": name, "uploadMode": _mode(name), "shouldIgnore": False} for name in names]
            self._answer({"files": modes})
        elif path.endswith(".git/info/lfs/objects/batch"):
            self._answer({"transfer": "basic", "objects": [self._place(each) for each in json.loads(body)["objects"]]})
        elif "/commit/" in path:
            self._take(path.split("/commit/")[0].removeprefix("/api/models/"), body.decode())
        else:
            self._answer({"error": f"{path} is not part of this stand-in"}, 404)

    def do_PUT(self) -> None:
        path, body = self._note(), self._body()
        self.server.large[path.removeprefix("/large/")] = body
        self._answer({})

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_GET(self) -> None:
        path = self._note()
        if path.startswith("/api/models/"):
            self._describe(path.removeprefix("/api/models/"))
        elif "/resolve/" in path:
            repository, rest = path[1:].split("/resolve/")
            self._give(repository, rest.split("/", 1)[1])
        else:
            self._answer({"error": f"{path} is not part of this stand-in"}, 404)

    def _describe(self, what: str) -> None:
        repository = "/".join(what.split("/")[:2])
        if repository not in self.server.files:
            self._answer({"error": "Repository not found"}, 404, {"X-Error-Code": "RepoNotFound"})
        elif "/tree/" in what:
            files = self.server.files[repository].items()
            self._answer([{"type": "file", "path": name, "size": len(data), "oid": _sha1(data)} for name, data in files])
        else:
            names = [{"rfilename": name} for name in self.server.files[repository]]
            self._answer({"id": repository, "sha": self.server.commit(repository), "siblings": names})

    def _give(self, repository: str, name: str) -> None:
        if name not in self.server.files.get(repository, {}):
            self._answer({"error": "Entry not found"}, 404, {"X-Error-Code": "EntryNotFound"})
            return
        data = self.server.files[repository][name]
        headers = {"ETag": f'"{_sha256(data)}"', "X-Repo-Commit": self.server.commit(repository)}
        self._send(data, 200, {"Content-Type": "application/octet-stream", **headers})

    def _place(self, wanted: dict[str, Any]) -> dict[str, Any]:
        upload = {"href": f"{self.server.url}/large/{wanted['oid']}"}
        return {"oid": wanted["oid"], "size": wanted["size"], "actions": {"upload": upload}}

    def _take(self, repository: str, lines: str) -> None:
        for line in map(json.loads, lines.splitlines()):
            value = line["value"]
            if line["key"] == "file":
                self.server.files[repository][value["path"]] = base64.b64decode(value["content"])
            elif line["key"] == "lfsFile":
                self.server.files[repository][value["path"]] = self.server.large[value["oid"]]
        commit = self.server.commit(repository)
        self._answer({"commitUrl": f"{self.server.url}/{repository}/commit/{commit}", "commitOid": commit})

    def _note(self) -> str:
        path = unquote(urlsplit(self.path).path)
        self.server.requests.append(Request(self.command, path, self.headers.get("Authorization")))
        return path

    def _may_write(self) -> bool:
        return self.headers.get("Authorization") == f"Bearer {self.server.token}"

    def _body(self) -> bytes:
        if self.headers.get("Transfer-Encoding") != "chunked":
            return self.rfile.read(int(self.headers.get("Content-Length", 0)))
        body = b""
        while size := int(self.rfile.readline(), 16):
            body += self.rfile.read(size)
            self.rfile.readline()
        self.rfile.readline()
        return body

    def _answer(self, content: Any, status: int = 200, headers: dict[str, str] | None = None) -> None:
        self._send(json.dumps(content).encode(), status, {"Content-Type": "application/json", **(headers or {})})

    def _send(self, body: bytes, status: int, headers: dict[str, str]) -> None:
        self.send_response(status)
        for name, value in {**headers, "Content-Length": str(len(body))}.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing."""


def _mode(name: str) -> str:
    return "lfs" if name.endswith(BINARY) else "regular"


def _sha1(data: bytes) -> str:
    return hashlib.sha1(data).hexdigest()


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


if __name__ == "__main__":
    hub = LocalHub("secret")
    print(hub.url, flush=True)
    hub.serve_forever()
