"""Files and folders that may be missing or closed to us."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from su3d_bench.core.errors import PredictionError, Su3dError


@contextmanager
def reading(where: str, error_class: type[Su3dError] = PredictionError) -> Iterator[None]:
    """What the system refuses in the block becomes an ``error_class`` that begins with ``where``."""
    try:
        yield
    except OSError as error:
        raise error_class(f"{where}: cannot be read: {error.strerror or error}") from error
