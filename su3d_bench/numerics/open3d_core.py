"""Open3D's compiled module without the Python packages around it."""

from __future__ import annotations

import importlib
import os
import sys
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from threading import Lock
from typing import Any

NAME = "open3d.cpu.pybind"
# Set by the package itself before it loads the module: torch may have loaded its own OpenMP.
ENVIRONMENT = {"KMP_DUPLICATE_LIB_OK": "True", "TCM_ENABLE": "1"}
_LOCK = Lock()


def compiled_open3d() -> Any:
    """The part of ``open3d`` for geometry and ray casting (``core``, ``geometry``, ``t``, ``utility``).

    The package imports Dash, pandas and scikit-learn for its viewers: 2.5 s of CPU time, 0.6 s without, in each process
    of a run. If the package is imported later, it uses the module loaded here. On a machine that may have a GPU the
    package itself is imported: it has another compiled module for GPUs, and the two cannot be mixed.
    """
    with _LOCK:
        if NAME in sys.modules and "open3d" not in sys.modules:
            return sys.modules[NAME]
        file = None if "open3d" in sys.modules or _may_have_gpu() else _module_file()
        if file is None:
            return importlib.import_module("open3d")
        os.environ.update(ENVIRONMENT)
        spec = spec_from_file_location(NAME, file)
        assert spec is not None and spec.loader is not None
        module = module_from_spec(spec)
        try:
            spec.loader.exec_module(module)
        except ImportError:  # a library that the package loads first; its own message is better
            return importlib.import_module("open3d")
        sys.modules[NAME] = module
        return module


def _may_have_gpu() -> bool:
    devices = Path("/dev")
    return (devices / "dxg").exists() or any(devices.glob("nvidia*"))


def _module_file() -> Path | None:
    """The file of the compiled module; only on Linux, where loading it alone is tested."""
    package = find_spec("open3d") if sys.platform == "linux" else None
    folders = [] if package is None else package.submodule_search_locations or []
    return next((file for folder in folders for file in sorted(Path(folder, "cpu").glob("pybind*.so"))), None)
