"""Evaluation and benchmarking of open-vocabulary, instance-level 3D scene understanding from RGB-D.

What a dataset, a method or a script of one's own needs is named here and imported at its first use, so that
``import su3d_bench`` stays instant.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from su3d_bench.core.maps import DenseFeatures, Instances, Masks, Partition
    from su3d_bench.core.system.timing import Timer
    from su3d_bench.core.types import Detections, Frame, GroundTruth, InstanceMesh, LabelSet, PerceptionNeeds, SceneInfo
    from su3d_bench.metrics.protocols.loading import load_protocol
    from su3d_bench.metrics.scoring import combine, score_scene
    from su3d_bench.numerics.geometry import back_project
    from su3d_bench.store.predictions import read_prediction

__version__ = "0.1.0"
__all__ = [
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
    "SceneInfo",
    "Timer",
    "back_project",
    "combine",
    "load_protocol",
    "read_prediction",
    "score_scene",
]
# Where those names are that are no types of ``core.types``.
_ELSEWHERE = {
    "DenseFeatures": "core.maps",
    "Instances": "core.maps",
    "Masks": "core.maps",
    "Partition": "core.maps",
    "Timer": "core.system.timing",
    "back_project": "numerics.geometry",
    "combine": "metrics.scoring",
    "load_protocol": "metrics.protocols.loading",
    "read_prediction": "store.predictions",
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
