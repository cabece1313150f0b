"""Content keys: what a result was made from, as short hexadecimal texts."""

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
# What shows numbers and moves none; everything else of the package counts, in whatever folder it stands.
NON_SCORING_PACKAGES = ("analysis", "api", "cli", "fetching", "reports", "reproducing", "human_eval")
# No part of the program: what Python and file managers leave, texts for people, what type checkers read.
NO_CODE = ("__pycache__", ".", ".pyc", ".md", "py.typed")
NUMERIC_PACKAGES = ("numpy", "scipy", "scikit-learn", "opencv-python-headless", "onnxruntime", "open3d", "numba")
RECORDED_PACKAGES = ("su3d-bench", *NUMERIC_PACKAGES, "pandas", "pydantic", "torch", "transformers")


def digest_bytes(content: bytes) -> str:
    """SHA-256 of ``content`` in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def digest_json(value: Any) -> str:
    """A key of a JSON-like value; equal values give equal keys whatever the order of their keys."""
    return digest_bytes(json.dumps(value, sort_keys=True, ensure_ascii=False).encode())


def digest_file(path: Path) -> str:
    """SHA-256 of a file's content."""
    with opened(path) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


@cache
def code_digest() -> str:
    """A key of the installed code, rules, tables and weights that can move a number."""
    names = {path.relative_to(PACKAGE_ROOT).parts[0] for path in _sources(PACKAGE_ROOT)}
    return package_digest(*sorted(names - set(NON_SCORING_PACKAGES)))[:16]


@cache
def package_digest(*names: str) -> str:
    """A key of parts of the package by their bytes: ``"metrics"``, all that lies in that folder and below, or one file.

    Raises ``FileNotFoundError`` for a name under which no file lies: a key of nothing would fit any code.
    """
    total = hashlib.sha256()
    for name in names:
        paths = sorted(_sources(PACKAGE_ROOT / name))
        if not paths:
            raise FileNotFoundError(f"{PACKAGE_ROOT / name}: holds no code of which a key could be made")
        for path in paths:
            total.update(f"{path.relative_to(PACKAGE_ROOT).as_posix()} {digest_file(path)}\n".encode())
    return total.hexdigest()


def _sources(place: Path) -> Iterator[Path]:
    """The files of ``place`` (a file, or a folder with all below) that belong to the program."""
    if place.is_file():
        yield place
    elif place.is_dir():
        for child in place.iterdir():
            if not (child.name.startswith(NO_CODE[:2]) or child.name.endswith(NO_CODE[2:])):
                yield from _sources(child)


@cache
def package_versions(names: tuple[str, ...] = RECORDED_PACKAGES) -> dict[str, str]:
    """Versions of the packages that a result depends on, and of Python; those not installed are left out."""
    versions = {"python": ".".join(str(part) for part in sys.version_info[:3])}
    for name in names:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    return versions


def git_state() -> dict[str, Any] | None:
    """Commit and dirty flag of the checkout that the code runs from; None where it is installed without one."""
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
