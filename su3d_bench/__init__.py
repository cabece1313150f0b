"""Evaluation and benchmarking of open-vocabulary, instance-level 3D scene understanding from RGB-D.

What a notebook, a script, a dataset or a method of one's own needs is named here and imported at its first use, so
that ``import su3d_bench`` stays instant.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

from su3d_bench.core.version import __version__ as __version__

if TYPE_CHECKING:
    from su3d_bench.api.lists import list_datasets, list_methods, list_protocols
    from su3d_bench.api.making import evaluate, run
    from su3d_bench.api.results import Comparison, Run, Scores, load_run
    from su3d_bench.core.errors import Su3dError
    from su3d_bench.core.geometry import back_project
    from su3d_bench.core.maps import DenseFeatures, Instances, Masks, Partition
    from su3d_bench.core.system.timing import Timer
    from su3d_bench.core.types import Detections, Frame, GroundTruth, InstanceMesh, LabelSet, PerceptionNeeds, SceneInfo
    from su3d_bench.metrics.protocols.loading import load_protocol
    from su3d_bench.metrics.scoring import combine, score_scene
    from su3d_bench.store.predictions import read_prediction

__all__ = [
    "Comparison",
    "DenseFeatures",
    "Detections",
    "Frame",
    "GroundTruth",
    "InstanceMesh",
    "Instances",
    "LabelSet",
    "Masks",
    "Partition",
    "PerceptionNeeds",
    "Run",
    "SceneInfo",
    "Scores",
    "Su3dError",
    "Timer",
    "back_project",
    "combine",
    "evaluate",
    "list_datasets",
    "list_methods",
    "list_protocols",
    "load_protocol",
    "load_run",
    "read_prediction",
    "run",
    "score_scene",
]
# Where those names are that are no types of ``core.types``.
_ELSEWHERE = {
    "Comparison": "api.results",
    "DenseFeatures": "core.maps",
    "Instances": "core.maps",
    "Masks": "core.maps",
    "Partition": "core.maps",
    "Run": "api.results",
    "Scores": "api.results",
    "Su3dError": "core.errors",
    "Timer": "core.system.timing",
    "back_project": "core.geometry",
    "combine": "metrics.scoring",
    "evaluate": "api.making",
    "list_datasets": "api.lists",
    "list_methods": "api.lists",
    "list_protocols": "api.lists",
    "load_protocol": "metrics.protocols.loading",
    "load_run": "api.results",
    "read_prediction": "store.predictions",
    "run": "api.making",
    "score_scene": "metrics.scoring",
}

# ONNX Runtime from 1.29 on tells its makers of every session and keeps an identity of the machine in the user's cache;
# it looks at this once, when it is loaded (microsoft/onnxruntime, pull request 27379). Who wants that sets 0.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_ELSEWHERE.get(name, 'core.types')}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
