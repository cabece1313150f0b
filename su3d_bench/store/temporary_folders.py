"""Temporary folders whose files are large: those of killed processes go when the next one is made."""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
from contextlib import suppress
from pathlib import Path
from types import TracebackType

from su3d_bench.core.errors import StoreError

HELD = ".held"  # a file in each folder that its process keeps locked; the lock ends with the process


class TemporaryFolder:
    """The folder ``path``, below the system's folder for temporary files, until ``close`` or the end of a block."""

    def __init__(self, prefix: str) -> None:
        try:
            _remove_abandoned(prefix)
            self.path = Path(tempfile.mkdtemp(prefix=prefix))
            unheld = self.path / f"{HELD}.new"
            self._lock = os.open(unheld, os.O_RDWR | os.O_CREAT, 0o600)
            fcntl.flock(self._lock, fcntl.LOCK_EX)
            unheld.rename(self.path / HELD)  # from here on others know the folder; until here they leave it alone
        except OSError as error:
            where = f" below {tempfile.tempdir}" if tempfile.tempdir else ""
            reason = error.strerror or str(error)
            raise StoreError(
                f"cannot make a temporary folder{where}: {reason}; set TMPDIR to a folder that can be written"
            ) from error

    def close(self) -> None:
        """Remove the folder; once is enough, twice is no fault."""
        if self._lock >= 0:
            shutil.rmtree(self.path, ignore_errors=True)
            os.close(self._lock)
            self._lock = -1

    def __enter__(self) -> Path:
        return self.path

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _remove_abandoned(prefix: str) -> None:
    for held in Path(tempfile.gettempdir()).glob(f"{prefix}*/{HELD}"):
        with suppress(OSError):  # in use, gone meanwhile, or somebody else's
            lock = os.open(held, os.O_RDWR | os.O_NOFOLLOW)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(held.parent, ignore_errors=True)
            finally:
                os.close(lock)
