"""What of this machine the program needs or can use, each with what was found and what to do."""

from __future__ import annotations

import os
import platform
import shutil
import sys
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from su3d_bench.cli.doctor.libraries import LOADED, PROGRAM, SYSTEM, Loaded, loaded, requirements, version_of
from su3d_bench.core.errors import Su3dError, counted, shown

State = Literal["ok", "note", "missing"]
LEAST_FREE = {"cache": 10**9, "data": 10**9, "temporary": 10**9, "runs": 10**9}  # bytes: a room, its cache, its run
LEAST_MEMORY = 4 * 10**9  # bytes: a room under opensu3d takes one; docs/running/performance.md
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class Check:
    """One line: ``missing`` is what the main job cannot run without, ``note`` what something else may want."""

    what: str
    state: State
    found: str
    to_do: str = ""


def examine() -> list[Check]:
    """Every check, in the order in which things are installed."""
    wanted = requirements()
    installed = {name: found for name in wanted if (found := version_of(name)) is not None}
    tried = loaded([name for name in LOADED if name in installed])
    return [
        _python(),
        *_libraries(wanted, installed, tried),
        *_system(tried),
        *_gpus(tried),
        *_folders(),
        _kernels(),
        *_datasets(),
        _models(),
        _cores(),
        _memory(),
        _terminal(),
    ]


def _python() -> Check:
    is_known = (3, 11) <= sys.version_info[:2] < (3, 13)
    found = f"{platform.python_version()} ({platform.system()} {platform.machine()})"
    return Check("Python", "ok" if is_known else "missing", found, "" if is_known else "3.11 or 3.12 is needed")


def _libraries(wanted: Mapping[str, str], installed: Mapping[str, str], tried: Mapping[str, Loaded]) -> Iterator[Check]:
    if not wanted:
        yield Check(PROGRAM, "missing", "is not installed", f"pip install {PROGRAM}")
        return
    yield Check(PROGRAM, "ok", version_of(PROGRAM) or "")
    for name, extra in wanted.items():
        if extra in ("test", "dev"):
            continue
        place = f"'{PROGRAM}[{extra}]'" if extra else PROGRAM
        if name not in installed:
            found = "is not installed" + (f": only the extra '{extra}' needs it" if extra else "")
            yield Check(name, "note" if extra else "missing", found, f"pip install {place}")
        elif name in tried and tried[name].fault:
            fault = f"{installed[name]} cannot be loaded: {tried[name].fault}"
            yield Check(name, "note" if extra else "missing", fault, f"pip install --force-reinstall {name}")
        else:
            yield Check(name, "ok", installed[name])


def _system(tried: Mapping[str, Loaded]) -> Iterator[Check]:
    if sys.platform != "linux":
        return
    absent = tried[""].found.get("missing", [])
    is_needed = bool(tried.get("open3d", Loaded()).fault)
    for library, package in SYSTEM.items():
        if library in absent:
            to_do = f"apt-get install {package}"
            yield Check(library, "missing" if is_needed else "note", "is not here; Open3D may need it", to_do)
        else:
            yield Check(library, "ok", "is here")


def _gpus(tried: Mapping[str, Loaded]) -> Iterator[Check]:
    torch, runtime = tried.get("torch"), tried.get("onnxruntime")
    if torch is not None and not torch.fault:
        gpus = torch.found.get("gpus") or []
        built = f"built for CUDA {torch.found['cuda']}" if torch.found.get("cuda") else "built for CPUs alone"
        to_do = "" if gpus else "computes on the CPU; for GPUs see docs/running/gpu.md"
        yield Check("GPU by torch", "ok" if gpus else "note", "; ".join(gpus) or f"none ({built})", to_do)
    if runtime is not None and not runtime.fault:
        providers = [name.removesuffix("ExecutionProvider") for name in runtime.found.get("providers", [])]
        yield Check("ONNX Runtime", "ok", f"computes by {', '.join(providers)}")


def _folders() -> Iterator[Check]:
    from su3d_bench.cli.datasets.list import data_root
    from su3d_bench.core.files.scratch import scratch_folder
    from su3d_bench.runs.scenes import cache_root
    from su3d_bench.store.caches import KINDS, cache_entries, size_text

    named = os.environ.get("SU3D_DATA") or ""
    if "://" in named:
        yield Check("data", "ok", f"{shown(Path(named))}: a store, which run and ablate read")
    else:
        yield _folder("data", data_root(), "SU3D_DATA")
    cache = _folder("cache", cache_root(), "SU3D_CACHE")
    n_bytes = sum(entry.n_bytes for kind in KINDS.values() for entry in cache_entries(cache_root(), kind))
    yield Check(cache.what, cache.state, f"{cache.found}; keeps {size_text(n_bytes)}", cache.to_do)
    yield _folder("temporary", scratch_folder(), "TMPDIR")
    yield _folder("runs", Path("runs").absolute(), "--out")


def _folder(what: str, folder: Path, setting: str) -> Check:
    """Whether files can be written, locked and have room where ``folder`` is or would be."""
    from su3d_bench.core.files.locks import NO_LOCKS, hold_folder
    from su3d_bench.store.caches import size_text

    existing = next((place for place in (folder, *folder.parents) if place.exists()), Path("/"))
    where = shown(folder) if existing == folder else f"{shown(folder)} (to be made)"
    try:
        with tempfile.TemporaryDirectory(dir=existing, prefix=".su3d-doctor-") as made:
            os.close(hold_folder(Path(made)))
    except OSError as error:
        if error.errno in NO_LOCKS:
            return Check(what, "note", f"{where}: its disk has no locks", f"best on another disk: {setting}")
        reason = error.strerror or str(error)
        return Check(what, "missing", f"{where}: cannot be written: {reason}", f"choose another with {setting}")
    free = shutil.disk_usage(existing).free
    if free < LEAST_FREE[what]:
        return Check(what, "note", f"{where}: {size_text(free)} free", f"make room, or another with {setting}")
    return Check(what, "ok", f"{where}: {size_text(free)} free")


def _kernels() -> Check:
    from su3d_bench.store.caches import kernel_folders, why_slow

    line = why_slow()
    if line is not None:
        return Check("compiled code", "note", line)
    return Check(
        "compiled code", "ok", f"is kept, in the first that takes it: {', '.join(map(shown, kernel_folders()))}"
    )


def _datasets() -> Iterator[Check]:
    from su3d_bench.cli.datasets.list import data_root
    from su3d_bench.core import registry

    if "://" in (os.environ.get("SU3D_DATA") or ""):
        return
    for name in registry.names("dataset"):
        try:
            dataset_class = registry.load("dataset", name)
            n_scenes = len(dataset_class(data_root(), dataset_class.Options()).scenes())
        except Su3dError:  # datasets list has its words
            n_scenes = 0
        if n_scenes:
            yield Check(f"dataset {name}", "ok", counted(n_scenes, "scene"))
        else:
            yield Check(f"dataset {name}", "note", "no scene is here", "su3d-bench datasets list says where it looks")


def _models() -> Check:
    from su3d_bench.perception.models.catalogue import MODELS
    from su3d_bench.perception.models.files import models_folder
    from su3d_bench.perception.models.inspection import model_state

    here = [name for name, entry in MODELS.items() if model_state(entry).files]
    found = f"{len(here)} of {len(MODELS)} in {shown(models_folder(None))} and the Hugging Face cache"
    if here:
        return Check("models", "ok", f"{found}: {', '.join(here)}")
    return Check("models", "note", f"{found}; only real models need them", "su3d-bench models list says what to fetch")


def _cores() -> Check:
    all_cores = os.cpu_count() or 1
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else all_cores
    told = ", ".join(f"{name}={os.environ[name]}" for name in THREADS if os.environ.get(name))
    return Check("cores", "ok", f"{usable} of {all_cores}{f'; {told}' if told else ''}")


def _memory() -> Check:
    import psutil

    from su3d_bench.store.caches import size_text

    memory = psutil.virtual_memory()
    found = f"{size_text(memory.total)}, {size_text(memory.available)} of it free"
    is_enough = memory.available >= LEAST_MEMORY
    return Check("memory", "ok" if is_enough else "note", found, "" if is_enough else "fewer scenes at once: --jobs 1")


def _terminal() -> Check:
    if not sys.stdout.isatty():
        return Check("terminal", "ok", "none here: no bars are drawn")
    size = shutil.get_terminal_size()
    return Check("terminal", "ok", f"{size.columns} columns, {sys.stdout.encoding}")
