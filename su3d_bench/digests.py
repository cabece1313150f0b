"""Content keys: what a result was made from, as short hexadecimal texts."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

PACKAGE_ROOT = Path(__file__).resolve().parent
# What moves a number; the command line and the reports only show it.
NUMERIC_FOLDERS = (
    "",
    "metrics",
    "opensu3d",
    "perception",
    "perception/language",
    "perception/models",
    "predictions",
    "questions",
    "reasoning",
    "datasets",
    "baselines",
    "rules",
)
NUMERIC_SUFFIXES = {".py", ".toml", ".json", ".tsv", ".csv", ".onnx", ".txt"}
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
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


@cache
def code_digest() -> str:
    """A key of the installed code, rules, tables and weights that can move a number."""
    total = hashlib.sha256()
    for folder in NUMERIC_FOLDERS:
        for path in sorted((PACKAGE_ROOT / folder).iterdir()):
            if path.is_file() and path.suffix in NUMERIC_SUFFIXES:
                total.update(f"{folder}/{path.name} {digest_file(path)}\n".encode())
    return total.hexdigest()[:16]


@cache
def package_versions(names: tuple[str, ...] = RECORDED_PACKAGES) -> dict[str, str]:
    """Versions of the packages that a result depends on, and of Python; those not installed are left out."""
    found = {"python": ".".join(str(part) for part in sys.version_info[:3])}
    for name in names:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


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
