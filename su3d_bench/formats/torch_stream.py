"""Files of ``torch.save`` in its older form, read without torch: pickles one after another, then the bytes of storages.

Source: ``_legacy_save`` of pytorch's serialization.py; some programs of today still ask for it, with
``_use_new_zipfile_serialization=False``.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from su3d_bench.core.errors import PredictionError, reading, shown
from su3d_bench.core.system.files import opened
from su3d_bench.formats.pickles.pickle_constructors import Constructors, Inert, RefusedError, empty_dict, inert
from su3d_bench.formats.pickles.pickles import read_pickle
from su3d_bench.formats.torch_zip import ZIP_START, Storage, StorageReference, constructors, read_torch

MAGIC, VERSION = 0x1950A86A20F9469CFC6C, 1001  # what the first two pickles of every such file hold
MAGIC_BYTES = MAGIC.to_bytes(10, "little")
MOST_START = 64  # the first pickle has 15 bytes, under newer protocols some more
SIZE_BYTES = 8  # of the number of values before those of a storage


def read_torch_of_either_form(path: Path) -> object:
    """The value that ``torch.save`` wrote, as an archive (see ``read_torch``) or as the stream that it once wrote."""
    where = shown(path)
    with reading(where), opened(path) as stream:
        start = stream.read(MOST_START)
        if start.startswith(ZIP_START):
            return read_torch(path)
        if MAGIC_BYTES not in start:
            raise PredictionError(f"{where}: no file of torch.save; copy it again")
        n_bytes = stream.seek(0, io.SEEK_END)
        stream.seek(0)
        return _Stream(stream, n_bytes, where).value()


class _Stream:
    """The parts of such a file, each read from where the one before it ends."""

    def __init__(self, stream: BinaryIO, n_bytes: int, where: str) -> None:
        self._stream, self._n_bytes, self._where = stream, n_bytes, where

    def value(self) -> object:
        """What was saved; it is gone through twice, as the bytes of its tensors stand behind it."""
        magic, version, system = self._pickle(), self._pickle(), self._pickle()
        if magic != MAGIC or version != VERSION or not isinstance(system, dict):
            raise self._damage("is of a form of torch.save that is not known")
        order = "<" if system.get("little_endian", True) is True else ">"
        start = self._stream.tell()
        references: dict[str, StorageReference] = {}

        def note(key: object) -> object:
            reference = StorageReference.of(key)
            if references.setdefault(reference.name, reference) != reference:
                raise RefusedError(f"two sizes of storage {reference.name}")
            return Inert()

        self._pickle(_outline(), note)
        names = self._pickle()
        if not isinstance(names, list) or len(names) != len(references):
            raise self._damage("does not name each storage once")
        storages: dict[str, Storage] = {}
        for name in names:
            if not isinstance(name, str) or name not in references or name in storages:
                raise self._damage("does not name each storage once")
            storages[name] = self._storage(references[name], order)
        if self._stream.read(1):
            raise self._damage("has more bytes behind its end")
        self._stream.seek(start)

        def find(key: object) -> object:
            reference = StorageReference.of(key)
            if references.get(reference.name) != reference:
                raise RefusedError(f"another storage {reference.name} than before")
            return storages[reference.name]

        return self._pickle(constructors(), find)

    def _storage(self, reference: StorageReference, order: str) -> Storage:
        n = int.from_bytes(self._stream.read(SIZE_BYTES), "little" if order == "<" else "big", signed=True)
        n_left = self._n_bytes - self._stream.tell()
        if n != reference.n or not 0 <= n * reference.width <= n_left:
            raise self._damage(
                f"has {n} values in storage {reference.name}, {reference.n} are used, {n_left} bytes left"
            )
        try:
            return reference.storage(self._stream.read(n * reference.width), order)
        except RefusedError as error:
            raise self._damage(f"has {error}") from error

    def _pickle(
        self, allowed: Constructors | None = None, persistent: Callable[[object], object] | None = None
    ) -> object:
        n_left = self._n_bytes - self._stream.tell()
        return read_pickle(
            self._stream, n_left, self._where, constructors=allowed or {}, persistent=persistent, is_last=False
        )

    def _damage(self, what: str) -> PredictionError:
        return PredictionError(f"{self._where}: {what}; copy the file again")


def _outline() -> Constructors:
    """The same names, of which nothing is made: what a pickle holds beside its containers does not matter yet."""
    return {name: construct if construct in (None, empty_dict) else inert for name, construct in constructors().items()}
