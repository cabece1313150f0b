"""Tiny things in the layouts in which they are published, on a server on loopback, and a table that says so."""

from __future__ import annotations

import hashlib
import io
import json
import tarfile
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from file_server import FileServer, Served, serve_repository

LICENCE = {"name": "MIT", "address": "https://example.org/licence", "read_at": "here"}


def zip_bytes(folder: Path) -> bytes:
    """The files below ``folder`` as a zip archive, by their paths in it."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(folder.rglob("*")):
            archive.write(path, path.relative_to(folder).as_posix())
    return out.getvalue()


def tar_bytes(folder: Path) -> bytes:
    """The same as ``tar -czf - .`` inside of it packs them."""
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w:gz") as archive:
        archive.add(folder, arcname=".")
    return out.getvalue()


def entry(name: str, group: str, files: Mapping[str, Mapping[str, Any]], **keys: Any) -> dict[str, Any]:
    """A row of the table: ``files`` by name with what is said of each."""
    rows = [{"name": file, "read_at": "here", **facts} for file, facts in files.items()]
    fixed = {"what": "a tiny one", "licence": LICENCE, "hosts": ["127.0.0.1"]}
    return {"name": name, "group": group, **fixed, "files": rows} | keys


def serve_file(server: FileServer, name: str, content: bytes, *, is_stated: bool = True) -> dict[str, Any]:
    """Serve a file; what the table says of it."""
    server.files[f"/{name}"] = Served(content)
    facts: dict[str, Any] = {"address": f"{server.url}/{name}", "n_bytes": len(content)}
    return facts | ({"sha256": hashlib.sha256(content).hexdigest()} if is_stated else {})


def serve_replica(server: FileServer, made: Path, n_parts: int = 3) -> list[dict[str, Any]]:
    """Serve what lies in ``made``: ``Replica`` as NICE-SLAM packs it, ``replica_v1`` cut like the release."""
    frames_root = made / "packed"
    frames_root.mkdir()
    (made / "Replica").rename(frames_root / "Replica")
    facts = serve_file(server, "Replica.zip", zip_bytes(frames_root), is_stated=False)
    del facts["n_bytes"]
    scene = next((made / "replica_v1").iterdir())
    (scene / "mesh.ply").write_bytes(b"not wanted")
    (scene / "textures").mkdir()
    (scene / "textures" / "0-color-ptex.hdr").write_bytes(b"not wanted either")
    whole = tar_bytes(made / "replica_v1")
    cuts = [len(whole) * i // n_parts for i in range(n_parts + 1)]
    parts = {
        f"replica_v1_0.tar.gz.parta{'abc'[i]}": serve_file(
            server, f"replica_v1_0.tar.gz.parta{'abc'[i]}", whole[cuts[i] : cuts[i + 1]], is_stated=False
        )
        for i in range(n_parts)
    }
    return [
        entry("replica-frames", "replica", {"Replica.zip": facts}, archive="zip"),
        entry("replica-meshes", "replica", parts, archive="tar.gz"),
    ]


def serve_model(server: FileServer, name: str, repository: str, folder: Path) -> dict[str, Any]:
    """Serve the files of ``folder`` as a repository of the hub; a row of the table."""
    serve_repository(server, repository, {path.name: path.read_bytes() for path in sorted(folder.iterdir())})
    names = [path.name for path in sorted(folder.iterdir()) if path.name != "model.safetensors"]
    hub = {
        "repository": repository,
        "files": ["model.safetensors | pytorch_model.bin", "config.json", "preprocessor_config.json"],
        "optional": [file for file in names if file not in ("config.json", "preprocessor_config.json")],
        "read_at": "here",
    }
    row = entry(name, "models", {}, hosts=["127.0.0.1", "localhost"])
    del row["files"]
    return row | {"hub": hub, "endpoint": server.url}


def write_table(place: Path, rows: list[dict[str, Any]]) -> Path:
    """A file for ``--sources``: TOML takes JSON's values but for the names of keys."""
    place.write_text("sources = " + _toml(rows) + "\n")
    return place


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return json.dumps(value)
