"""Requests and replies kept with a run, addressed by content, so that a rerun asks nothing.

``<key>.json`` holds a request and its reply; ``images/<digest>.png`` each picture once. Of two processes that ask the
same at the same time the first to finish is kept, and both get its reply.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from su3d_bench.core.digests import digest_json
from su3d_bench.core.files.atomic import json_text, make_folder, write_bytes, write_error, write_text
from su3d_bench.core.files.locks import hold_folder
from su3d_bench.core.system.files import file_text
from su3d_bench.perception.language.chat import ChatRequest, Reply
from su3d_bench.store.run_folder import refuse_links

SCHEMA = 1
IMAGES = "images"
MOST_ENTRY_BYTES = 200_000_000  # twice the largest answer that a configuration can allow


_REPLY = TypeAdapter(Reply)


class ReplyStore:
    """The folder ``language`` of a run."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def path(self, key: str) -> Path:
        return self.folder / f"{key}.json"

    def load(self, key: str) -> Reply | None:
        """The reply under ``key``; None where there is none, or one that is damaged."""
        path = self.path(key)
        try:
            if not path.is_file() or path.stat().st_size > MOST_ENTRY_BYTES:
                return None
            entry: Any = json.loads(file_text(path))
            digests = digest_json(entry["request"]), digest_json(entry["reply"])
            if entry["schema"] != SCHEMA or digests != (key, entry["reply_sha256"]):
                return None
            return dataclasses.replace(_REPLY.validate_python(entry["reply"]), was_stored=True)
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            return None

    def save(self, request: ChatRequest, reply: Reply, server: str, *, replace: bool = False) -> Reply:
        """The reply that is kept: ``reply``, or the one that another process stored meanwhile unless ``replace``."""
        refuse_links(self.folder.parent, self.folder / IMAGES)
        make_folder(self.folder)
        with self._locked():
            earlier = None if replace else self.load(request.key)
            if earlier is not None:
                return earlier
            self._save_images(request)
            answer = _REPLY.dump_python(reply, mode="json", exclude={"was_stored"})
            entry = {
                "schema": SCHEMA,
                "purpose": request.purpose,
                "server": server,
                "request": request.record(),
                "reply": answer,
                "reply_sha256": digest_json(answer),
            }
            write_text(self.path(request.key), json_text(entry))
        return reply

    def _save_images(self, request: ChatRequest) -> None:
        if request.images:
            make_folder(self.folder / IMAGES)
        for image in request.images:
            path = self.folder / IMAGES / f"{image.digest}.png"
            if not path.is_file():
                write_bytes(path, image.png)

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """Hold the folder against other threads and processes; the lock leaves no file behind."""
        try:
            handle = hold_folder(self.folder, waits=True)
        except OSError as error:
            raise write_error(self.folder, error) from error
        try:
            yield
        finally:
            os.close(handle)
