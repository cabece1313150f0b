"""Libraries as this machine has them: their versions, and what comes of loading them in a process of their own."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, requires, version
from typing import Any

from su3d_bench.core.errors import printable

PROGRAM = "su3d-bench"
PATIENCE_S = 180.0  # of one import, on a disk that is read for the first time
# What is loaded to see whether it can be: a compiled library that lacks another one may end the whole process.
LOADED = {
    "numba": "import numba; found = {}",
    "opencv-python-headless": "import cv2; found = {}",
    "onnxruntime": "import onnxruntime; found = {'providers': onnxruntime.get_available_providers()}",
    "open3d": "from su3d_bench.numerics.open3d_core import compiled_open3d; compiled_open3d(); found = {}",
    "torch": "import torch; n = torch.cuda.device_count() if torch.cuda.is_available() else 0; about = "
    "[torch.cuda.get_device_properties(i) for i in range(n)]; found = {'cuda': torch.version.cuda, 'gpus': "
    "[f'{one.name}, {one.total_memory / 1e9:.0f} GB' for one in about]}",
}
# Open3D's, and what brings each on Debian and Ubuntu.
SYSTEM = {"libGL.so.1": "libgl1", "libX11.so.6": "libx11-6", "libgomp.so.1": "libgomp1"}
SYSTEM_CODE = (
    "import ctypes\nfound = {'missing': []}\n"
    f"for name in {list(SYSTEM)!r}:\n"
    "    try:\n        ctypes.CDLL(name)\n"
    "    except OSError:\n        found['missing'].append(name)\n"
)


@dataclass(frozen=True)
class Loaded:
    """What came of loading a library: what it said of itself, or the ``fault``."""

    found: Mapping[str, Any] = field(default_factory=dict)
    fault: str = ""


def requirements() -> dict[str, str]:
    """The packages that the installed program asks for, and the extra to which each belongs ("" for the core)."""
    try:
        lines = requires(PROGRAM) or []
    except PackageNotFoundError:
        return {}
    wanted: dict[str, str] = {}
    for line in lines:
        name = re.match(r"[A-Za-z0-9_.-]+", line)
        extra = re.search(r"extra == ['\"]([\w-]+)['\"]", line)
        if name is not None:
            wanted.setdefault(name[0], extra[1] if extra else "")
    return wanted


def version_of(package: str) -> str | None:
    """The version that is installed, if any."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def loaded(packages: Sequence[str]) -> dict[str, Loaded]:
    """What came of loading each of ``packages`` that ``LOADED`` knows, and of the system's libraries (``""``)."""
    codes = {"": SYSTEM_CODE} | {package: LOADED[package] for package in packages if package in LOADED}
    with ThreadPoolExecutor(max_workers=2) as pool:
        return dict(zip(codes, pool.map(_tried, codes.values()), strict=True))


def _tried(code: str) -> Loaded:
    """What the Python ``code`` leaves in ``found``, run in a process of its own."""
    text = f"{code}\nimport json, sys\nsys.stdout.write('\\n' + json.dumps(found))"
    path = os.pathsep.join(folder for folder in sys.path if folder)
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-c", text],  # -P: nothing in the folder where one stands takes a library's place
            capture_output=True,
            text=True,
            errors="replace",
            timeout=PATIENCE_S,
            stdin=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": path},
        )
    except subprocess.TimeoutExpired:
        return Loaded(fault=f"took longer than {PATIENCE_S:.0f} s to load")
    if done.returncode < 0:
        return Loaded(fault=f"ended by signal {-done.returncode} while it was loaded")
    try:
        return Loaded(found=json.loads(done.stdout.splitlines()[-1]))
    except (ValueError, IndexError):
        return Loaded(fault=printable((done.stderr.strip().splitlines() or ["said nothing"])[-1], 200))
