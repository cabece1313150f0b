"""File servers on loopback that behave like the real ones, well or badly, and record requests.

``FileServer`` serves plain files with ranges, validators and redirections; ``serve_repository`` makes it answer like
the Hugging Face hub: a list of a repository's files with checksums, and large files by redirection to another host.
The other ``serve_`` functions serve tiny files in their published layouts, and return the matching row of a
table of sources.
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import threading
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Self

REVISION = "0123456789abcdef0123456789abcdef01234567"
LICENCE = {"name": "MIT", "address": "https://example.org/licence", "read_at": "here"}


class LocalServer:
    """A server on loopback that answers each request with ``respond``."""

    def __init__(self) -> None:
        server = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def handle(self) -> None:
                """Clients may close the connection at any moment, also while the next request is awaited."""
                with suppress(ConnectionError):
                    super().handle()

            def do_GET(self) -> None:
                server.respond(self)

            def do_POST(self) -> None:
                server.respond(self)

            def log_message(self, *words: Any) -> None:
                pass

        self._http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._http.daemon_threads = True
        self.port = self._http.server_address[1]
        threading.Thread(target=self._http.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()

    def respond(self, handler: BaseHTTPRequestHandler) -> None:
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._http.shutdown()
        self._http.server_close()


def send(handler: BaseHTTPRequestHandler, status: int, headers: Mapping[str, str], body: bytes) -> None:
    """An answer to a client that may have disconnected."""
    with suppress(OSError):
        handler.send_response(status)
        for name, value in headers.items():
            handler.send_header(name, value)
        handler.end_headers()
        handler.wfile.write(body)


@dataclass
class Served:
    """A file and how it is served: ``breaks_after`` lists byte counts at which answers are cut, one per answer."""

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

    def start(self, headers: Mapping[str, str]) -> int | None:
        """The start of a requested part, if it matches the client's version (RFC 9110, 13.1.5)."""
        wanted = re.fullmatch(r"bytes=(\d+)-", headers.get("range", ""))
        is_same = headers.get("if-range") in (None, self.tag())
        return int(wanted[1]) if wanted is not None and self.takes_ranges and is_same else None


@dataclass(frozen=True)
class Asked:
    path: str
    headers: Mapping[str, str]

    @property
    def range(self) -> str | None:
        return self.headers.get("range")


class FileServer(LocalServer):
    """``files`` by path; ``url`` uses 127.0.0.1, ``other_host`` localhost."""

    def __init__(self) -> None:
        super().__init__()
        self.files: dict[str, Served] = {}
        self.asked: list[Asked] = []
        self.url, self.other_host = f"http://127.0.0.1:{self.port}", f"http://localhost:{self.port}"

    def respond(self, handler: BaseHTTPRequestHandler) -> None:
        path = handler.path.partition("?")[0]
        asked = Asked(path, {name.lower(): value for name, value in handler.headers.items()})
        self.asked.append(asked)
        served = self.files.get(path, Served(b"no such file", status=404))
        if served.redirect is not None:
            send(handler, 302, {"Location": served.redirect, "Content-Length": "0"}, b"")
            return
        start, n_bytes, status, body = served.start(asked.headers), len(served.content), served.status, served.content
        stated = {"ETag": served.tag()} if served.tag() else {}
        if start is not None:
            status, body = (206 if start < n_bytes else 416), body[start:]
            stated["Content-Range"] = f"bytes {start}-{n_bytes - 1}/{n_bytes}" if body else f"bytes */{n_bytes}"
        if served.states_size or status == 416:
            stated["Content-Length"] = str(len(body))
        else:
            stated["Connection"] = "close"
        if served.breaks_after:
            body = body[: served.breaks_after.pop(0)]
            handler.close_connection = True
        send(handler, status, stated | served.headers, body)


def serve_repository(server: FileServer, repository: str, files: Mapping[str, bytes], *, large: int = 1000) -> None:
    """A repository of the hub; files of at least ``large`` bytes are stored on another host."""
    siblings = []
    for name, content in files.items():
        blob = hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()
        row: dict[str, Any] = {"rfilename": name, "size": len(content), "blobId": blob}
        served = Served(content)
        if len(content) >= large:
            sha256 = hashlib.sha256(content).hexdigest()
            row |= {"blobId": "0" * 40, "lfs": {"sha256": sha256, "size": len(content), "pointerSize": 134}}
            server.files[f"/store/{sha256}"] = served
            served = Served(b"", redirect=f"{server.other_host}/store/{sha256}")
        server.files[f"/{repository}/resolve/{REVISION}/{name}"] = served
        siblings.append(row)
    listing = {"_id": "1", "id": repository, "modelId": repository, "sha": REVISION, "siblings": siblings}
    answer = Served(json.dumps(listing).encode(), headers={"Content-Type": "application/json"})
    server.files[f"/api/models/{repository}"] = server.files[f"/api/models/{repository}/revision/main"] = answer


def entry(name: str, group: str, files: Mapping[str, Mapping[str, Any]], **keys: Any) -> dict[str, Any]:
    """A row of the table: ``files`` by name with their entries."""
    rows = [{"name": file, "read_at": "here", **facts} for file, facts in files.items()]
    fixed = {"what": "a tiny one", "licence": LICENCE, "hosts": ["127.0.0.1"]}
    return {"name": name, "group": group, **fixed, "files": rows} | keys


def serve_file(server: FileServer, name: str, content: bytes, *, is_stated: bool = True) -> dict[str, Any]:
    """Serve a file; its entry in the table."""
    server.files[f"/{name}"] = Served(content)
    facts: dict[str, Any] = {"address": f"{server.url}/{name}", "n_bytes": len(content)}
    return facts | ({"sha256": hashlib.sha256(content).hexdigest()} if is_stated else {})


def serve_replica(server: FileServer, made: Path) -> list[dict[str, Any]]:
    """Serve the content of ``made``: ``Replica`` packed as by NICE-SLAM, ``replica_v1`` in parts like the release."""
    packed = shutil.make_archive(str(made / "frames"), "zip", made, "Replica")
    facts = serve_file(server, "Replica.zip", Path(packed).read_bytes(), is_stated=False)
    del facts["n_bytes"]
    shutil.rmtree(made / "Replica")
    scene = next((made / "replica_v1").iterdir())
    (scene / "textures").mkdir()
    for name in ("mesh.ply", "textures/0-color-ptex.hdr"):
        (scene / name).write_bytes(b"not wanted")
    whole = Path(shutil.make_archive(str(made / "meshes"), "gztar", made / "replica_v1")).read_bytes()
    parts = {}
    for i, letter in enumerate("abc"):
        name, content = f"replica_v1_0.tar.gz.parta{letter}", whole[len(whole) * i // 3 : len(whole) * (i + 1) // 3]
        parts[name] = serve_file(server, name, content, is_stated=False)
    return [
        entry("replica-frames", "replica", {"Replica.zip": facts}, archive="zip"),
        entry("replica-meshes", "replica", parts, archive="tar.gz"),
    ]


def serve_model(server: FileServer, name: str, repository: str, folder: Path) -> dict[str, Any]:
    """Serve the files of ``folder`` as a repository of the hub; a row of the table."""
    contents = {path.name: path.read_bytes() for path in sorted(folder.iterdir())}
    serve_repository(server, repository, contents)
    files = ["model.safetensors | pytorch_model.bin", "config.json", "preprocessor_config.json"]
    optional = [name for name in contents if name not in (*files, "model.safetensors")]
    hub = {"repository": repository, "files": files, "optional": optional, "read_at": "here"}
    return hub_entry(server, name, hub)


def hub_entry(server: FileServer, name: str, hub: dict[str, Any]) -> dict[str, Any]:
    row = entry(name, "models", {}, hosts=["127.0.0.1", "localhost"], endpoint=server.url, hub=hub)
    del row["files"]
    return row


def write_table(place: Path, rows: list[dict[str, Any]]) -> Path:
    """A file for ``--sources``: TOML accepts JSON's values, but not its keys."""
    place.write_text("sources = " + _toml(rows) + "\n")
    return place


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return json.dumps(value)
