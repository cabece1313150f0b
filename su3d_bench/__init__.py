"""Evaluation and benchmarking of open-vocabulary, instance-level 3D scene understanding from RGB-D.

The public names for notebooks, scripts and user-defined datasets and methods; each is imported at its first use, so
that ``import su3d_bench`` stays fast.
"""

import os
import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

from su3d_bench.core.version import __version__ as __version__

if TYPE_CHECKING:
    from su3d_bench.api.lists import list_datasets as list_datasets
    from su3d_bench.api.lists import list_methods as list_methods
    from su3d_bench.api.lists import list_protocols as list_protocols
    from su3d_bench.api.run import evaluate as evaluate
    from su3d_bench.api.run import run as run
    from su3d_bench.api.session import session as session
    from su3d_bench.api.tables import Comparison as Comparison
    from su3d_bench.api.tables import Run as Run
    from su3d_bench.api.tables import Scores as Scores
    from su3d_bench.api.tables import load_run as load_run
    from su3d_bench.core.errors import Su3dError as Su3dError
    from su3d_bench.core.geometry import back_project as back_project
    from su3d_bench.core.maps import DenseFeatures as DenseFeatures
    from su3d_bench.core.maps import Instances as Instances
    from su3d_bench.core.maps import Masks as Masks
    from su3d_bench.core.maps import Partition as Partition
    from su3d_bench.core.system.timing import Timer as Timer
    from su3d_bench.core.types import Detections as Detections
    from su3d_bench.core.types import Frame as Frame
    from su3d_bench.core.types import GroundTruth as GroundTruth
    from su3d_bench.core.types import InstanceMesh as InstanceMesh
    from su3d_bench.core.types import LabelSet as LabelSet
    from su3d_bench.core.types import PerceptionNeeds as PerceptionNeeds
    from su3d_bench.core.types import SceneInfo as SceneInfo
    from su3d_bench.metrics.protocols.loading import load_protocol as load_protocol
    from su3d_bench.metrics.scoring import combine as combine
    from su3d_bench.metrics.scoring import score_scene as score_scene
    from su3d_bench.store.predictions import read_prediction as read_prediction

# The public names, by module.
_MODULES = {
    "api.lists": ("list_datasets", "list_methods", "list_protocols"),
    "api.run": ("evaluate", "run"),
    "api.session": ("session",),
    "api.tables": ("Comparison", "Run", "Scores", "load_run"),
    "core.errors": ("Su3dError",),
    "core.geometry": ("back_project",),
    "core.maps": ("DenseFeatures", "Instances", "Masks", "Partition"),
    "core.system.timing": ("Timer",),
    "core.types": ("Detections", "Frame", "GroundTruth", "InstanceMesh", "LabelSet", "PerceptionNeeds", "SceneInfo"),
    "metrics.protocols.loading": ("load_protocol",),
    "metrics.scoring": ("combine", "score_scene"),
    "store.predictions": ("read_prediction",),
}
if sys.platform == "win32":  # without fcntl
    raise SystemExit("su3d-bench: needs Linux or macOS; on Windows use WSL")
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}
__all__ = sorted(_MODULE_OF)

# ONNX Runtime 1.29 and later sends telemetry for every session and stores a machine id in the user's cache; it reads
# this variable once, on import (microsoft/onnxruntime, pull request 27379). Set it to 0 to allow telemetry.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
