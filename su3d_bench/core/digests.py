"""Content keys: hexadecimal digests of everything that a result was made from."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from su3d_bench.core.system.files import opened

PACKAGE_ROOT = Path(__file__).resolve().parents[1]
# Packages that display numbers and change none; everything else in the package counts, in any folder.
NON_SCORING_PACKAGES = ("analysis", "api", "cli", "fetching", "reports", "reproducing", "human_eval")
# Not part of the program: files of Python and file managers, documentation, type-checker markers.
NO_CODE = ("__pycache__", ".", ".pyc", ".md", "py.typed")
NUMERIC_PACKAGES = ("numpy", "scipy", "scikit-learn", "opencv-python-headless", "onnxruntime", "open3d", "numba", "av")
RECORDED_PACKAGES = ("su3d-bench", *NUMERIC_PACKAGES, "pandas", "pydantic", "torch", "transformers")


def digest_bytes(content: bytes) -> str:
    """SHA-256 of ``content`` in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def digest_json(value: Any) -> str:
    """A digest of a JSON-like value; it does not depend on the order of the value's keys."""
    return digest_bytes(json.dumps(value, sort_keys=True, ensure_ascii=False).encode())


def digest_file(path: Path) -> str:
    """SHA-256 of a file's content."""
    with opened(path) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


@cache
def code_digest() -> str:
    """A digest of the installed code, rules, tables and weights that can change a number."""
    names = {path.relative_to(PACKAGE_ROOT).parts[0] for path in _sources(PACKAGE_ROOT)}
    return package_digest(*sorted(names - set(NON_SCORING_PACKAGES)))[:16]


@cache
def package_digest(*names: str) -> str:
    """A digest of parts of the package: a folder with all files below it, such as ``"metrics"``, or one file.

    Raises ``FileNotFoundError`` for a name without files: a digest of nothing would match any code.
    """
    total = hashlib.sha256()
    for name in names:
        paths = sorted(_sources(PACKAGE_ROOT / name))
        if not paths:
            raise FileNotFoundError(f"{PACKAGE_ROOT / name}: contains no code to digest")
        for path in paths:
            total.update(f"{path.relative_to(PACKAGE_ROOT).as_posix()} {digest_file(path)}\n".encode())
    return total.hexdigest()


def _sources(place: Path) -> Iterator[Path]:
    """The files of ``place`` (a file, or a folder and everything below it) that belong to the program."""
    if place.is_file():
        yield place
    elif place.is_dir():
        for child in place.iterdir():
            if not (child.name.startswith(NO_CODE[:2]) or child.name.endswith(NO_CODE[2:])):
                yield from _sources(child)


@cache
def package_versions(names: tuple[str, ...] = RECORDED_PACKAGES) -> dict[str, str]:
    """Versions of the packages that a result depends on, and of Python; packages not installed are omitted."""
    versions = {"python": ".".join(str(part) for part in sys.version_info[:3])}
    for name in names:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    return versions


def git_state() -> dict[str, Any] | None:
    """Commit and dirty flag of the checkout that the code runs from; None if it is not a checkout."""
    commands = (["rev-parse", "HEAD"], ["status", "--porcelain", "--untracked-files=no"])
    answers = []
    for command in commands:
        try:
            done = subprocess.run(["git", *command], cwd=PACKAGE_ROOT, capture_output=True, text=True, timeout=10)
        except (OSError, subprocess.TimeoutExpired):
            return None
        if done.returncode != 0:
            return None
        answers.append(done.stdout.strip())
    return {"commit": answers[0], "is_dirty": bool(answers[1])}
