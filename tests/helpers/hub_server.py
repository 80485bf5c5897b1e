"""A Hugging Face Hub on this machine: the part of its HTTP interface that downloads use."""

from __future__ import annotations

import hashlib
import json
import os
import re
import subprocess
import sys
import threading
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import unquote

API = re.compile(r"/api/(?:models|datasets)/(?P<name>[^/]+/[^/]+)(?:/revision/(?P<revision>.+))?")
FILE = re.compile(r"/(?:datasets/)?(?P<name>[^/]+/[^/]+)/resolve/(?P<revision>[^/]+)/(?P<path>.+)")
LOCAL = "127.0.0.1"


@dataclass
class Repository:
    """A published repository: the commits of its branches, and the files of its commits."""

    branches: dict[str, str] = field(default_factory=dict)
    commits: dict[str, dict[str, bytes]] = field(default_factory=dict)

    def commit(self, files: dict[str, bytes], branch: str = "main") -> str:
        """Adds a commit, and moves a branch to it."""
        names = json.dumps(sorted((name, hashlib.sha1(data).hexdigest()) for name, data in files.items()))
        commit = hashlib.sha1(names.encode()).hexdigest()
        self.commits[commit] = files
        self.branches[branch] = commit
        return commit


class Hub:
    """The server.

    Attributes:
        repositories: What is published, by id.
        requests: Method and path of each request so far.
        status: The answer to every request instead of the right one, such as 503.
        gated: Whether files are denied. As on the Hub, everybody may list them.
        cut: Name of a file of which only a half is sent.
    """

    def __init__(self) -> None:
        self.repositories: dict[str, Repository] = {}
        self.requests: list[tuple[str, str]] = []
        self.status: int | None = None
        self.gated = False
        self.cut = ""
        hub = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_GET(self) -> None:
                hub.answer(self, with_body=True)

            def do_HEAD(self) -> None:
                hub.answer(self, with_body=False)

            def log_message(self, *_: Any) -> None:
                """Nothing."""

        self._server = ThreadingHTTPServer((LOCAL, 0), Handler)
        self._server.daemon_threads = True
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        self.endpoint = f"http://{LOCAL}:{self._server.server_port}"

    def close(self) -> None:
        """Ends the server; its port then refuses connections."""
        self._server.shutdown()
        self._server.server_close()

    def downloaded(self) -> list[str]:
        """The names of the files that were asked for with GET, in ascending order."""
        found = (FILE.fullmatch(path) for method, path in self.requests if method == "GET")
        return sorted({match["path"] for match in found if match is not None})

    def answer(self, handler: BaseHTTPRequestHandler, with_body: bool) -> None:
        """Answers one request."""
        path = unquote(handler.path.partition("?")[0])
        self.requests.append((handler.command, path))
        if self.status is not None:
            self._send(handler, self.status, with_body=with_body)
            return
        match = API.fullmatch(path) or FILE.fullmatch(path)
        repository = None if match is None else self.repositories.get(match["name"])
        if match is None or repository is None:
            self._send(handler, 404, {"X-Error-Code": "RepoNotFound"}, with_body=with_body)
            return
        revision = match["revision"] or "main"
        commit = repository.branches.get(revision, revision)
        files = repository.commits.get(commit)
        if files is None:
            self._send(handler, 404, {"X-Error-Code": "RevisionNotFound"}, with_body=with_body)
        elif match.re is API:
            about = {"id": match["name"], "sha": commit, "siblings": [{"rfilename": one} for one in files]}
            body = json.dumps(about).encode()
            self._send(handler, 200, {"Content-Type": "application/json"}, body, with_body)
        elif self.gated:
            self._send(handler, 403, {"X-Error-Code": "GatedRepo"}, with_body=with_body)
        elif match["path"] not in files:
            self._send(handler, 404, {"X-Error-Code": "EntryNotFound"}, with_body=with_body)
        else:
            body = files[match["path"]]
            headers = {"X-Repo-Commit": commit, "ETag": f'"{hashlib.sha1(body).hexdigest()}"'}
            self._send(handler, 200, headers, body, with_body, is_cut=match["path"] == self.cut)

    def _send(
        self,
        handler: BaseHTTPRequestHandler,
        status: int,
        headers: dict[str, str] | None = None,
        body: bytes = b"",
        with_body: bool = True,
        is_cut: bool = False,
    ) -> None:
        handler.send_response(status)
        for name, value in (headers or {}).items():
            handler.send_header(name, value)
        handler.send_header("Content-Length", str(len(body)))
        handler.end_headers()
        if with_body:
            handler.wfile.write(body[: len(body) // 2] if is_cut else body)
        handler.close_connection = is_cut


def files_of(folder: Path) -> dict[str, bytes]:
    """The files of a folder by name."""
    files = (file for file in sorted(folder.rglob("*")) if file.is_file())
    return {file.relative_to(folder).as_posix(): file.read_bytes() for file in files}


def run(program: str, endpoint: str, home: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Runs a program with its own cache and this endpoint; huggingface_hub reads both when it is imported."""
    kept = {
        name: value
        for name, value in os.environ.items()
        if not name.upper().endswith("_PROXY") and not name.startswith("HF_")
    }
    settings = {"HF_ENDPOINT": endpoint, "HF_HOME": str(home), "HF_HUB_DISABLE_TELEMETRY": "1"}
    return subprocess.run(
        [sys.executable, "-c", program],
        env=kept | settings | environment,
        cwd=home,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
