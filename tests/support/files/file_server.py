"""Servers of files on loopback that behave as the real ones do, well or badly, and count what they are asked.

``FileServer`` gives plain files with ranges, validators and redirections; ``hub_files`` makes it answer as Hugging
Face's hub does: a list of a repository's files with their checksums, and large files by a redirection to another host.
"""

from __future__ import annotations

import hashlib
import json
import re
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

REVISION = "0123456789abcdef0123456789abcdef01234567"


@dataclass
class Served:
    """A file and how it is given: ``breaks_after`` bytes of an answer, once a number in the list, the line is cut."""

    content: bytes
    etag: str | None = None
    takes_ranges: bool = True
    states_size: bool = True
    breaks_after: list[int] = field(default_factory=list)
    redirect: str | None = None
    status: int = 200
    headers: dict[str, str] = field(default_factory=dict)

    def tag(self) -> str:
        return self.etag if self.etag is not None else f'"{hashlib.md5(self.content).hexdigest()}"'


@dataclass(frozen=True)
class Asked:
    path: str
    range: str | None
    headers: Mapping[str, str]


class FileServer:
    """``files`` by path; ``url`` names it as 127.0.0.1, ``other_host`` as localhost."""

    def __init__(self) -> None:
        self.files: dict[str, Served] = {}
        self.asked: list[Asked] = []
        server = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def handle(self) -> None:
                with suppress(ConnectionError):
                    super().handle()

            def do_GET(self) -> None:
                server.respond(self)

            def log_message(self, *words: Any) -> None:
                pass

        self._http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._http.daemon_threads = True
        port = self._http.server_address[1]
        self.url, self.other_host = f"http://127.0.0.1:{port}", f"http://localhost:{port}"
        threading.Thread(target=self._http.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()

    def paths(self) -> list[str]:
        return [asked.path for asked in self.asked]

    def respond(self, handler: BaseHTTPRequestHandler) -> None:
        path = handler.path.partition("?")[0]
        headers = {name.lower(): value for name, value in handler.headers.items()}
        self.asked.append(Asked(path, headers.get("range"), headers))
        served = self.files.get(path, Served(b"no such file", status=404))
        if served.redirect is not None:
            handler.send_response(302)
            handler.send_header("Location", served.redirect)
            handler.send_header("Content-Length", "0")
            handler.end_headers()
            return
        start, content = self._part(served, headers), served.content
        status = 206 if start is not None and start < len(content) else served.status
        if start is not None and start >= len(content):
            status = 416
        body = b"" if status == 416 else content[start or 0 :]
        handler.send_response(status)
        if served.tag():
            handler.send_header("ETag", served.tag())
        if status == 206:
            handler.send_header("Content-Range", f"bytes {start}-{len(content) - 1}/{len(content)}")
        if status == 416:
            handler.send_header("Content-Range", f"bytes */{len(content)}")
        if served.states_size or status == 416:
            handler.send_header("Content-Length", str(len(body)))
        else:
            handler.send_header("Connection", "close")
            handler.close_connection = True
        for name, value in served.headers.items():
            handler.send_header(name, value)
        handler.end_headers()
        if served.breaks_after:
            body = body[: served.breaks_after.pop(0)]
            handler.close_connection = True
        with suppress(OSError):
            handler.wfile.write(body)

    @staticmethod
    def _part(served: Served, headers: Mapping[str, str]) -> int | None:
        """From where on a part is given: asked for, and of the state that the asker holds (RFC 9110, 13.1.5)."""
        wanted = re.fullmatch(r"bytes=(\d+)-", headers.get("range", ""))
        if wanted is None or not served.takes_ranges:
            return None
        condition = headers.get("if-range")
        return None if condition is not None and condition != served.tag() else int(wanted[1])

    def close(self) -> None:
        self._http.shutdown()
        self._http.server_close()


@contextmanager
def file_server() -> Iterator[FileServer]:
    server = FileServer()
    try:
        yield server
    finally:
        server.close()


def git_blob(content: bytes) -> str:
    return hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()


def serve_repository(server: FileServer, repository: str, files: Mapping[str, bytes], *, large: int = 1000) -> None:
    """A repository of the hub; files of at least ``large`` bytes lie in its store of large files on another host."""
    siblings = []
    for name, content in files.items():
        row: dict[str, Any] = {"rfilename": name, "size": len(content), "blobId": git_blob(content)}
        place = f"/{repository}/resolve/{REVISION}/{name}"
        if len(content) >= large:
            sha256 = hashlib.sha256(content).hexdigest()
            row |= {"blobId": "0" * 40, "lfs": {"sha256": sha256, "size": len(content), "pointerSize": 134}}
            server.files[f"/store/{sha256}"] = Served(content)
            server.files[place] = Served(b"", redirect=f"{server.other_host}/store/{sha256}")
        else:
            server.files[place] = Served(content)
        siblings.append(row)
    listing = {"_id": "1", "id": repository, "modelId": repository, "sha": REVISION, "siblings": siblings}
    answer = Served(json.dumps(listing).encode(), headers={"Content-Type": "application/json"})
    server.files[f"/api/models/{repository}"] = answer
    server.files[f"/api/models/{repository}/revision/main"] = answer
