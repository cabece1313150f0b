"""The run folder: atomic writes, content keys, one writer at a time.

A job is one scene under one method. It has two *steps*, ``predict`` and ``score``; ``done.json`` seals each with the
key of all its inputs and the SHA-256 of the files that it vouches for. A file that is damaged or missing makes its
step run anew; a step sealed under another key is refused, naming the field that changed.
"""

from __future__ import annotations

import errno
import fcntl
import io
import json
import os
import secrets
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.damage import DAMAGE
from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import PredictionError, StoreError
from su3d_bench.core.types import DenseFeatures, Instances, Partition, Prediction
from su3d_bench.store.atomic import read_arrays
from su3d_bench.store.scratch import row_blocks

SCHEMA = 1
ROWS_AT_ONCE = 8192  # 16 MB of half precision at 1024 dimensions
ZIP_EPOCH = (1980, 1, 1, 0, 0, 0)
REASONS = {
    errno.ENOSPC: "the disk is full; free some space and run the same command again",
    errno.EDQUOT: "the disk quota is used up; free some space and run the same command again",
    errno.EACCES: "the folder is read-only; choose another with --out",
    errno.EPERM: "the folder is read-only; choose another with --out",
    errno.EROFS: "the folder is read-only; choose another with --out",
    errno.EFBIG: "the file grows beyond what this disk or account allows; raise the limit or choose another with --out",
    errno.ENOLCK: "this disk has no locks to give; choose a folder on another disk with --out",
    errno.ENOTDIR: "a file stands where a folder should be; choose another with --out",
    errno.EEXIST: "a file stands where a folder should be; choose another with --out",
}
# What a lock on a folder itself gets from network disks, which lock files that are open for writing only: flock(2).
NO_FOLDER_LOCKS = (errno.EBADF, errno.EINVAL, errno.ENOTSUP, errno.ENOSYS)
LOCK_FILE = ".lock"
# Dimensions and kinds of values of each field of a stored prediction; see Instances, Partition and DenseFeatures.
FIELDS = {
    "points": (2, "f"),
    "indptr": (1, "i"),
    "indices": (1, "i"),
    "scores": (1, "f"),
    "features": (2, "f"),
    "labels": (1, "U"),
    "names": (1, "U"),
    "captions": (1, "U"),
    "boxes": (3, "f"),
    "centroids": (2, "f"),
    "view_indptr": (1, "i"),
    "views": (2, "i"),
    "view_names": (1, "U"),
    "view_scores": (1, "f"),
    "ids": (1, "i"),
    "instance": (1, "i"),
}
WRITTEN_BY_ALL = ("language", "language/images")  # where all jobs of a run write; a job clears its own folders


def _store_error(path: Path, error: OSError) -> StoreError:
    reason = REASONS.get(error.errno or 0, error.strerror or str(error))
    return StoreError(f"cannot write {path}: {reason}")


def make_folder(path: Path) -> None:
    """Make ``path`` and its parents."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _store_error(path, error) from error


@contextmanager
def _replacing(path: Path) -> Iterator[IO[bytes]]:
    """A stream whose bytes take the place of ``path`` at the end, whole or not at all."""
    # Machines that share a disk may have processes of one number.
    temporary = path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}.tmp")
    try:
        with temporary.open("wb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    except BaseException as error:
        with suppress(OSError):  # a read-only disk refuses even to remove what is not there
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise _store_error(path, error) from error
        raise


def write_bytes(path: Path, content: bytes) -> None:
    """Put ``content`` at ``path``, whole or not at all, even when the process or the machine dies meanwhile."""
    with _replacing(path) as stream:
        stream.write(content)


def remove_file(path: Path) -> None:
    """Remove ``path`` where it exists."""
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise _store_error(path, error) from error


def write_text(path: Path, text: str) -> None:
    write_bytes(path, text.encode())


def json_text(value: Any) -> str:
    """JSON as every file of a run has it: two spaces, full precision, no NaN."""
    return json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def write_json(path: Path, value: Any) -> None:
    write_text(path, json_text(value))


def npz_bytes(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """An .npz archive without pickle whose bytes depend on the arrays alone."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            member = io.BytesIO()
            np.lib.format.write_array(member, np.asarray(array), version=(1, 0), allow_pickle=False)
            entry = zipfile.ZipInfo(f"{name}.npy", date_time=ZIP_EPOCH)
            archive.writestr(entry, member.getvalue())
    return buffer.getvalue()


def write_npz(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    write_bytes(path, npz_bytes(arrays))


def read_npz(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of an .npz file; a damaged file is a ``StoreError``."""
    try:
        return read_arrays(path)
    except DAMAGE as error:
        raise StoreError(f"{path}: not a readable .npz file ({error}); delete it and run again") from error


def is_file(path: Path) -> bool:
    """Whether there is such a file; none has a name that no system could give, as a hostile record may say."""
    try:
        return path.is_file()
    except OSError:
        return False


def read_json(path: Path) -> Any:
    """The value of a JSON file; a missing or damaged file is a ``StoreError``."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise StoreError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise StoreError(f"{path}: not readable as JSON; run the same command again to mend it") from error


def prediction_arrays(prediction: Prediction) -> dict[str, NDArray[Any]]:
    """A prediction as named arrays, ``kind`` among them; absent fields are left out."""
    arrays = {"kind": np.array(type(prediction).__name__)}
    for name in prediction.__dataclass_fields__:
        value = getattr(prediction, name)
        if value is not None:
            arrays[name] = np.array(value, dtype=np.str_) if isinstance(value, tuple) else value
    return arrays


def prediction_from_arrays(arrays: Mapping[str, NDArray[Any]], where: str) -> Prediction:
    """The reverse of ``prediction_arrays``; ``where`` begins the message when the arrays are no prediction."""
    kinds = {kind.__name__: kind for kind in (Instances, Partition, DenseFeatures)}
    kind = kinds.get(str(arrays.get("kind")))
    if kind is None:
        raise PredictionError(f"{where}: holds no 'kind' out of {', '.join(kinds)}; it is not a prediction")
    for name in (name for name in FIELDS if name in arrays):
        array, (n_dimensions, value_kind) = arrays[name], FIELDS[name]
        if array.ndim != n_dimensions or array.dtype.kind != value_kind or (name == "indptr" and not array.size):
            shape = f"of shape {array.shape} {array.dtype.name}"
            raise PredictionError(f"{where}: '{name}' is an array {shape}; run the scene again")
    values: dict[str, Any] = {}
    for name in kind.__dataclass_fields__:
        value = arrays.get(name)
        values[name] = tuple(str(item) for item in value) if value is not None and value.dtype.kind == "U" else value
    optional = {"features", "labels", "view_names", "view_scores"}
    missing = [name for name, value in values.items() if value is None and name not in optional]
    if missing:
        raise PredictionError(f"{where}: lacks '{missing[0]}'; write it again with su3d-bench run")
    prediction: Prediction = kind(**values)
    return prediction


def features_beside(path: Path) -> Path:
    """Where the features of a dense prediction at ``path`` are: a file of their own, read without loading it."""
    return path.with_name(f"{path.name.removesuffix('.npz')}.features.npy")


def write_prediction(path: Path, prediction: Prediction) -> None:
    """Store ``prediction`` at ``path``, the features of a dense one beside it."""
    arrays, features_path = prediction_arrays(prediction), features_beside(path)
    if isinstance(prediction, DenseFeatures):
        _write_rows(features_path, arrays.pop("features"))
    else:
        remove_file(features_path)
    write_npz(path, arrays)


def _write_rows(path: Path, table: NDArray[Any]) -> None:
    """Put ``table`` at ``path`` as a .npy file, a block at a time."""
    descr = np.lib.format.dtype_to_descr(table.dtype)
    with _replacing(path) as stream:
        header = {"descr": descr, "fortran_order": False, "shape": table.shape}
        np.lib.format.write_array_header_1_0(stream, header)
        for _, block in row_blocks(table, ROWS_AT_ONCE):
            stream.write(np.ascontiguousarray(block).data)


def read_prediction(path: Path) -> Prediction:
    """The prediction that a run stored at ``path``; features of a dense one are memory-mapped."""
    arrays = read_npz(path)
    if str(arrays.get("kind")) == DenseFeatures.__name__ and "features" not in arrays:
        arrays["features"] = _mapped_rows(features_beside(path))
        if "points" not in arrays or arrays["features"].shape[:1] != arrays["points"].shape[:1]:
            raise StoreError(f"{features_beside(path)}: has other rows than {path.name}; delete both and run again")
    return prediction_from_arrays(arrays, str(path))


def _mapped_rows(path: Path) -> NDArray[Any]:
    try:
        table: NDArray[Any] = np.lib.format.open_memmap(path, mode="r")
    except DAMAGE as error:
        raise StoreError(f"{path}: not a readable .npy file ({error}); delete it and run again") from error
    if table.ndim != 2 or table.dtype.kind != "f":
        raise StoreError(f"{path}: holds {table.dtype} {table.shape}, no rows of features; delete it and run again")
    return table


@dataclass(frozen=True)
class RunFolder:
    """Where one run's files are; see DESIGN for the layout."""

    path: Path

    def job(self, scene: str, method: str) -> JobFolder:
        """The folder of one scene (``<dataset>/<scene>``) under one method."""
        return JobFolder(self.path / "scenes" / scene.replace("/", ".", 1).replace("/", "_") / method)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the folder against a second run; the lock dies with the process and leaves no file behind."""
        make_folder(self.path)
        handle = _lock(self.path)
        try:
            for folder in (self.path, *(self.path / name for name in WRITTEN_BY_ALL)):
                _clear_half_written(folder)
            yield
        finally:
            os.close(handle)


def _lock(folder: Path) -> int:
    """An open file that holds the lock of ``folder``; a ``StoreError`` where another process has it."""
    handle = -1
    try:
        handle = os.open(folder, os.O_RDONLY)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in NO_FOLDER_LOCKS:
                raise
            os.close(handle)
            handle = os.open(folder / LOCK_FILE, os.O_RDWR | os.O_CREAT, 0o666)
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if handle >= 0:
            os.close(handle)
        if isinstance(error, BlockingIOError):
            message = f"{folder}: another run is writing here; wait for it or choose another folder with --out"
            raise StoreError(message) from error
        raise _store_error(folder, error) from error
    return handle


def _clear_half_written(folder: Path) -> None:
    for leftover in folder.glob(".*.tmp"):
        remove_file(leftover)


@dataclass(frozen=True)
class JobFolder:
    """The files of one scene under one method."""

    path: Path

    @property
    def prediction(self) -> Path:
        return self.path / "prediction.npz"

    def anytime(self, share: float) -> Path:
        """The map after the first ``share`` of the updates."""
        return self.path / f"anytime-{share:g}.npz"

    def anytime_counts(self, share: float) -> Path:
        """The counts of that map."""
        return self.path / f"anytime-{share:g}-counts.npz"

    @property
    def counts(self) -> Path:
        return self.path / "counts.npz"

    @property
    def updates(self) -> Path:
        return self.path / "updates.csv"

    @property
    def log(self) -> Path:
        return self.path / "log.txt"

    @property
    def pictures(self) -> Path:
        return self.path / "pictures"

    @property
    def done(self) -> Path:
        return self.path / "done.json"

    def prepare(self) -> None:
        """Make the folder and clear what a killed run left half written."""
        make_folder(self.path)
        for folder in (self.path, self.pictures):
            _clear_half_written(folder)

    def seals(self) -> dict[str, Any]:
        """The sealed steps; nothing where ``done.json`` is missing or damaged."""
        try:
            record = read_json(self.done)
        except StoreError:
            return {}
        steps = record.get("steps") if isinstance(record, dict) and record.get("schema") == SCHEMA else None
        return steps if isinstance(steps, dict) else {}

    def seal(
        self, step: str, key: Mapping[str, str], files: Sequence[Path], remarks: Mapping[str, Any] | None = None
    ) -> None:
        """Vouch for ``files`` as the outcome of ``step`` under ``key``; sealing ``predict`` breaks the other seal.

        The features beside a dense prediction go with it. ``remarks`` are kept beside them for whoever resumes.
        """
        steps = {} if step == "predict" else self.seals()
        beside = [table for file in files if (table := features_beside(file)) != file and table.is_file()]
        digests = {file.relative_to(self.path).as_posix(): digest_file(file) for file in [*files, *beside]}
        steps[step] = {"key": dict(key), "files": digests, "remarks": dict(remarks or {})}
        write_json(self.done, {"schema": SCHEMA, "steps": steps})

    def remarks(self, step: str) -> dict[str, Any]:
        """What was kept beside the seal of ``step``."""
        return self._part(step, "remarks")

    def changed_field(self, step: str, key: Mapping[str, str], *, known_later: Sequence[str] = ()) -> str | None:
        """A clause that names the first field in which the sealed key differs from ``key``; None where none does.

        Fields in ``known_later`` are not compared.
        """
        sealed = self._part(step, "key")
        if not sealed or (key.items() <= sealed.items() and sealed.keys() - key.keys() <= set(known_later)):
            return None
        for name in [*key, *(name for name in sealed if name not in key)]:
            if name not in known_later and sealed.get(name) != key.get(name):
                return f"{name} was {sealed.get(name, 'not set')}, now {key.get(name, 'not set')}"
        return None

    def _part(self, step: str, part: str) -> dict[str, Any]:
        seal = self.seals().get(step)
        found = seal.get(part) if isinstance(seal, dict) else None
        return found if isinstance(found, dict) else {}

    def is_done(self, step: str, key: Mapping[str, str]) -> bool:
        """Whether ``step`` is sealed under exactly ``key`` and every file that it vouches for is whole."""
        return self.is_whole(self.seals().get(step), key)

    def is_whole(self, seal: Any, key: Mapping[str, str]) -> bool:
        """Whether ``seal``, one of ``seals``, is of exactly ``key`` and every file that it vouches for is whole."""
        files = seal.get("files") if isinstance(seal, dict) else None
        if not isinstance(files, dict) or not files or seal.get("key") != dict(key):
            return False
        return all((self.path / name).is_file() and digest_file(self.path / name) == sha for name, sha in files.items())
