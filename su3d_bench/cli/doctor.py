"""``su3d-bench dev doctor``: check the installation and suggest fixes."""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from su3d_bench.cli.output import answer_either, size_text
from su3d_bench.core.errors import EXIT_CHECK_FAILED, EXIT_DONE, Su3dError, counted, printable, shown
from su3d_bench.core.version import documentation

PROGRAM = "su3d-bench"
PATIENCE_S = 180.0  # per import, from a cold disk
MIN_FREE_BYTES = 10**9  # bytes: a room, its cache, its run
MIN_MEMORY = 4 * 10**9  # bytes: a room under opensu3d needs 10**9; docs/running/performance.md
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
# Imported in a child process: a compiled library with a missing dependency can crash it.
LOADED = {
    "numba": "import numba; found = {}",
    "opencv-python-headless": "import cv2; found = {}",
    "onnxruntime": "import onnxruntime; found = {'providers': onnxruntime.get_available_providers()}",
    "open3d": "import open3d; found = {}",
    "torch": "import torch; n = torch.cuda.device_count() if torch.cuda.is_available() else 0; found = {'cuda': "
    "torch.version.cuda, 'gpus': [torch.cuda.get_device_name(i) for i in range(n)]}",
}
FOR_OPEN3D = "apt-get install libgl1 libx11-6 libgomp1"  # on Debian and Ubuntu


@dataclass(frozen=True)
class Check:
    """One line: ``missing`` means that the main job cannot run, ``note`` is optional."""

    what: str
    state: Literal["ok", "note", "missing"]
    found: str
    to_do: str = ""


def call(arguments: argparse.Namespace) -> int:
    """Check libraries, GPU, data, models, folders and cores; exit code 1 if a required one is missing.

    su3d-bench dev doctor
    su3d-bench dev doctor --json
    """
    checks = examine()
    missing = [check for check in checks if check.state == "missing"]
    width = max(len(check.what) for check in checks)
    texts = ("; ".join(part for part in (check.found, check.to_do) if part) for check in checks)
    lines = [f"{check.state:<7}  {check.what:<{width}}  {text}" for check, text in zip(checks, texts, strict=True)]
    verdict = f"cannot run: {counted(len(missing), 'thing')} missing" if missing else "can run"
    value = {"can_run": not missing, "checks": [asdict(check) for check in checks]}
    answer_either(arguments, value, *lines, "", f"the main job {verdict}")
    return EXIT_CHECK_FAILED if missing else EXIT_DONE


def examine() -> list[Check]:
    """All checks, in order of installation."""
    return [_python(), *_libraries(), *_folders(), *_datasets(), _models(), _cores(), _memory()]


def _python() -> Check:
    is_known = (3, 11) <= sys.version_info[:2] < (3, 13)
    found = f"{platform.python_version()} ({platform.system()} {platform.machine()})"
    return Check("Python", "ok" if is_known else "missing", found, "" if is_known else "3.11 or 3.12 is needed")


def requirements() -> dict[str, str]:
    """The required packages, and the extra to which each belongs ("" for the core)."""
    from importlib.metadata import PackageNotFoundError, requires

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
    return {name: extra for name, extra in wanted.items() if extra not in ("test", "dev", "docs")}


def version_of(package: str) -> str | None:
    """The installed version, or None."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _libraries() -> Iterator[Check]:
    wanted = requirements()
    if not wanted:
        yield Check(PROGRAM, "missing", "is not installed", f"pip install {PROGRAM}")
        return
    yield Check(PROGRAM, "ok", version_of(PROGRAM) or "")
    for name, extra in wanted.items():
        installed = version_of(name)
        state: Literal["note", "missing"] = "note" if extra else "missing"
        if installed is None:
            found = "is not installed" + (f": only the extra '{extra}' needs it" if extra else "")
            yield Check(name, state, found, f"pip install '{PROGRAM}[{extra}]'" if extra else f"pip install {PROGRAM}")
            continue
        found_by, fault = loaded(name)
        if fault:
            to_do = FOR_OPEN3D if name == "open3d" else f"pip install --force-reinstall {name}"
            yield Check(name, state, f"{installed} cannot be loaded: {fault}", to_do)
        else:
            yield Check(name, "ok", f"{installed}{_abilities(found_by)}")


def _abilities(found: dict[str, Any]) -> str:
    """The devices that a library reports."""
    if "providers" in found:
        return f"; providers: {', '.join(name.removesuffix('ExecutionProvider') for name in found['providers'])}"
    if "gpus" not in found:
        return ""
    built = f"built for CUDA {found['cuda']}" if found["cuda"] else "built for CPU only"
    return f"; {', '.join(found['gpus']) or f'no GPU ({built}), see ' + documentation('running/gpu')}"


def loaded(package: str) -> tuple[dict[str, Any], str]:
    """What ``package`` reports when imported in a child process, and the error if the import fails."""
    if package not in LOADED:
        return {}, ""
    text = f"{LOADED[package]}\nimport json, sys\nsys.stdout.write('\\n' + json.dumps(found))"
    path = os.pathsep.join(folder for folder in sys.path if folder)
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-c", text],  # -P: files in the current folder must not shadow a library
            capture_output=True,
            text=True,
            errors="replace",
            timeout=PATIENCE_S,
            stdin=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": path},
        )
    except subprocess.TimeoutExpired:
        return {}, f"took longer than {PATIENCE_S:.0f} s to load"
    if done.returncode < 0:
        return {}, f"ended by signal {-done.returncode} while it was loaded"
    try:
        return json.loads(done.stdout.splitlines()[-1]), ""
    except (ValueError, IndexError):
        return {}, printable((done.stderr.strip().splitlines() or ["printed nothing"])[-1], 200)


def _folders() -> Iterator[Check]:
    from su3d_bench.core.files.atomic import scratch_folder
    from su3d_bench.runs.scenes import cache_root, data_root

    yield _folder("data", data_root(), "SU3D_DATA")
    yield _folder("cache", cache_root(), "SU3D_CACHE")
    yield _folder("temporary", scratch_folder(), "TMPDIR")
    yield _folder("runs", Path("runs").absolute(), "--out")


def _folder(what: str, folder: Path, setting: str) -> Check:
    """Check that ``folder`` can be written and locked and has free space."""
    from su3d_bench.core.files.locks import NO_LOCKS, hold_folder

    existing = next((place for place in (folder, *folder.parents) if place.exists()), Path("/"))
    where = shown(folder) if existing == folder else f"{shown(folder)} (not created yet)"
    try:
        with tempfile.TemporaryDirectory(dir=existing, prefix=".su3d-doctor-") as made:
            os.close(hold_folder(Path(made)))
    except OSError as error:
        if error.errno in NO_LOCKS:
            return Check(what, "note", f"{where}: no support for file locks", f"choose another with {setting}")
        reason = error.strerror or str(error)
        return Check(what, "missing", f"{where}: cannot be written: {reason}", f"choose another with {setting}")
    found = f"{where}: {size_text(free := shutil.disk_usage(existing).free)} free"
    if free >= MIN_FREE_BYTES:
        return Check(what, "ok", found)
    return Check(what, "note", found, f"free some space, or choose another with {setting}")


def _datasets() -> Iterator[Check]:
    from su3d_bench.core import registry
    from su3d_bench.runs.scenes import data_root

    for name in registry.names("dataset"):
        try:
            dataset_class = registry.load("dataset", name)
            n_scenes = len(dataset_class(data_root(), dataset_class.Options()).scenes())
        except Su3dError:  # datasets list shows the reason
            n_scenes = 0
        hint = "" if n_scenes else "to see where it is searched: su3d-bench datasets list"
        yield Check(f"dataset {name}", "note" if hint else "ok", counted(n_scenes, "scene"), hint)


def _models() -> Check:
    from su3d_bench.perception.models.catalogue import MODELS
    from su3d_bench.perception.models.files import models_folder
    from su3d_bench.perception.models.loading import model_state

    here = [name for name, entry in MODELS.items() if model_state(entry).files]
    found = f"{len(here)} of {len(MODELS)} in {shown(models_folder(None))} and the Hugging Face cache"
    if here:
        return Check("models", "ok", f"{found}: {', '.join(here)}")
    return Check(
        "models", "note", f"{found}; only real models need them", "to see what to fetch: su3d-bench models list"
    )


def _cores() -> Check:
    all_cores = os.cpu_count() or 1
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else all_cores
    threads = ", ".join(f"{name}={os.environ[name]}" for name in THREADS if os.environ.get(name))
    return Check("cores", "ok", f"{usable} of {all_cores}{f'; {threads}' if threads else ''}")


def _memory() -> Check:
    import psutil

    memory = psutil.virtual_memory()
    found = f"{size_text(memory.total)}, {size_text(memory.available)} of it free"
    is_enough = memory.available >= MIN_MEMORY
    return Check("memory", "ok" if is_enough else "note", found, "" if is_enough else "fewer scenes at once: --jobs 1")
