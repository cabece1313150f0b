"""What is wrong with the values that somebody's own dataset or method gives, and the form in which they are kept."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.maps import DenseFeatures, Instances, Masks, Partition
from su3d_bench.core.types import (
    Frame,
    GroundTruth,
    ImageDomain,
    InstanceMesh,
    LabelSet,
    PerceptionNeeds,
    SceneInfo,
    Surface,
)
from su3d_bench.store.predictions import array_fault, prediction_arrays, value_fault

# The types in which arrays are kept. What is of the same kind is brought into them, what is of another is refused.
FORMS: dict[str, type] = {
    **dict.fromkeys(("points", "features", "boxes", "centroids", "vertices", "evaluation_points"), np.float32),
    **dict.fromkeys(("scores", "view_scores"), np.float64),
    **dict.fromkeys(("indptr", "view_indptr", "ids"), np.int64),
    **dict.fromkeys(("indices", "views", "instance", "semantic", "every_semantic"), np.int32),
    **dict.fromkeys(("triangles", "instance_of_triangle", "segments"), np.int32),
}
ELEMENTS: dict[str, type] = {"scenes": str, "files": Path, "places": Path, "problems": str}
TEXTS = ("labels", "names", "captions", "view_names")
MOST_INT32 = np.iinfo(np.int32).max


def fault_of(found: Any) -> str | None:
    """What is wrong with an answer of the right type; None where nothing is."""
    match found:
        case SceneInfo():
            return _fault_of_info(found)
        case Frame():
            return _fault_of_frame(found)
        case GroundTruth():
            return _fault_of_truth(found)
        case InstanceMesh():
            return _fault_of_mesh(found)
        case Surface():
            return _fault_of_surface(found)
        case PerceptionNeeds():
            return _fault_of_needs(found)
        case Instances() | Partition() | DenseFeatures():
            return _fault_of_prediction(found)
    return None


def fault_of_list(name: str, found: Sequence[Any]) -> str | None:
    """Which entry of what the function ``name`` gives is not what it must be; None where all are."""
    kind = ELEMENTS.get(name, object)
    for k in range(len(found)):
        if not isinstance(found[k], kind):
            return f"entry {k} is {found[k]!r}, a {type(found[k]).__name__}; a {kind.__name__} is expected"
    twice = len(set(found)) != len(found) if kind is str and name == "scenes" else False
    return f"one of the {len(found)} names stands there twice" if twice else None


def in_stored_form(found: Any) -> Any:
    """``found`` with each array in the type in which it is kept, and lists of texts as tuples."""
    if not isinstance(found, Instances | Partition | DenseFeatures | GroundTruth | InstanceMesh | Surface):
        return found
    changed: dict[str, Any] = {}
    for name in (field.name for field in fields(found)):
        value = getattr(found, name)
        if isinstance(value, list) and name in TEXTS:
            changed[name] = tuple(value)
        if isinstance(found, DenseFeatures) and name == "features":
            continue  # as large as it may be, and in half precision
        if isinstance(value, np.ndarray) and name in FORMS and _is_of_kind(value, np.dtype(FORMS[name])):
            changed[name] = value.astype(FORMS[name])
    return replace(found, **changed) if changed else found


def _is_of_kind(value: NDArray[Any], form: np.dtype[Any]) -> bool:
    """Whether ``value`` is of another type than ``form`` that holds nothing which ``form`` cannot hold but digits."""
    if value.dtype == form or value.dtype.kind not in ("iu" if form.kind == "i" else "f"):
        return False
    if form.kind == "f" or not value.size:
        return True
    return bool(np.iinfo(form).min <= value.min() and value.max() <= np.iinfo(form).max)


def _fault_of_info(info: SceneInfo) -> str | None:
    for name, least in (("n_frames", 0), ("stride", 1)):
        value = getattr(info, name)
        if not isinstance(value, int | np.integer) or value < least:
            return f"{name} is {value!r}; a whole number from {least} on is expected"
    if info.image_domain not in get_args(ImageDomain):
        return f"image_domain is {info.image_domain!r}; {' or '.join(map(repr, get_args(ImageDomain)))} is expected"
    return None


def _fault_of_frame(frame: Frame) -> str | None:
    depth = frame.depth_m
    if depth.size and not (depth.min() >= 0 and depth.max() < np.inf):  # NaN is neither
        return "depth holds values that are negative or not finite; metres are expected, and 0 where there is none"
    return None


def _fault_of_truth(truth: GroundTruth) -> str | None:
    if fault := _fault_of_fields(truth, {"points": "f", "semantic": "i", "instance": "i"}):
        return fault
    if fault := _fault_of_type("labels", truth.labels, LabelSet):
        return fault
    if not np.isfinite(truth.points).all():
        return "points holds values that are not finite"
    known = np.maximum(truth.semantic, 0)  # below it is -1 alone, for points that are left out
    if (fault := _fault_of_range("instance", truth.instance)) or (fault := _fault_of_range("semantic", known)):
        return fault
    every = truth.every_semantic
    if every is not None and every.dtype.kind != "i":
        return f"every_semantic is {every.dtype}; whole numbers are expected"
    for name, ids, no_class in (("semantic", truth.semantic, (-1, 0)), ("every_semantic", every, (0,))):
        unknown = np.setdiff1d(() if ids is None else ids, (*no_class, *truth.labels.ids))
        if len(unknown):
            return f"{name} holds the class id {int(unknown[0])}, which its labels do not have"
    return None


def _fault_of_mesh(mesh: InstanceMesh) -> str | None:
    if fault := _fault_of_surface(mesh) or _fault_of_fields(mesh, {"instance_of_triangle": "i"}):
        return fault
    if mesh.instance_of_triangle.shape != (len(mesh.triangles),):
        return f"instance_of_triangle is {mesh.instance_of_triangle.shape} for {len(mesh.triangles)} triangles"
    if fault := _fault_of_range("instance_of_triangle", mesh.instance_of_triangle):
        return fault
    for name, kind in (("labels", LabelSet), ("class_of_instance", Mapping)):
        if fault := _fault_of_type(name, getattr(mesh, name), kind):
            return fault
    for instance in np.unique(mesh.instance_of_triangle[mesh.instance_of_triangle > 0]).tolist():
        if mesh.class_of_instance.get(instance) not in mesh.labels.ids:
            known = mesh.class_of_instance.get(instance, "no class")
            return f"class_of_instance has {known} for instance {instance}; a class id of its labels is expected"
    return None


def _fault_of_surface(mesh: InstanceMesh | Surface) -> str | None:
    if fault := _fault_of_fields(mesh, {"vertices": "f", "triangles": "i"}):
        return fault
    for name in ("vertices", "triangles"):
        shape = getattr(mesh, name).shape
        if len(shape) != 2 or shape[1] != 3:
            return f"{name} is {shape}; ({name[0].upper()}, 3) is expected"
    if not np.isfinite(mesh.vertices).all():
        return "vertices holds values that are not finite"
    corners = mesh.triangles
    if corners.size and not 0 <= corners.min() <= corners.max() < len(mesh.vertices):
        return f"triangles holds {corners.min()} to {corners.max()}, there are {len(mesh.vertices)} vertices"
    return None


def _fault_of_range(name: str, ids: NDArray[Any]) -> str | None:
    if ids.size and not 0 <= ids.min() <= ids.max() <= MOST_INT32:
        return f"{name} holds {ids.min()} to {ids.max()}; ids lie from 0 to {MOST_INT32}, 0 where there is none"
    return None


def _fault_of_type(name: str, value: Any, kind: type) -> str | None:
    return None if isinstance(value, kind) else f"{name} is a {type(value).__name__}; a {kind.__name__} is expected"


def _fault_of_fields(found: Any, kinds: Mapping[str, str]) -> str | None:
    """Which field is no array of floats (``f``) or integers (``i``)."""
    for name, kind in kinds.items():
        value = getattr(found, name)
        wanted = "floats" if kind == "f" else "integers"
        if not isinstance(value, np.ndarray):
            return f"{name} is a {type(value).__name__}; an array of {wanted} is expected"
        if value.dtype.kind not in ("iu" if kind == "i" else kind):
            return f"{name} is an array of {value.dtype.name}, not of {wanted}"
    return None


def _fault_of_prediction(prediction: Instances | Partition | DenseFeatures) -> str | None:
    for name in (field.name for field in fields(prediction)):
        value = getattr(prediction, name)
        if value is not None and name not in TEXTS and not isinstance(value, np.ndarray):
            return f"'{name}' is a {type(value).__name__}; an array is expected"
    if fault := array_fault(prediction_arrays(prediction)):
        return fault
    if fault := value_fault(prediction):
        return fault
    features = None if isinstance(prediction, DenseFeatures) else prediction.features
    if features is not None and not np.isfinite(features).all():
        row = int(np.flatnonzero(~np.isfinite(features).all(axis=1))[0])
        return f"'features' has values that are NaN or infinite, first in row {row}"
    return _fault_of_masks(prediction) if isinstance(prediction, Instances) else None


def _fault_of_masks(instances: Instances) -> str | None:
    k = len(instances)
    for name in ("boxes", "centroids"):
        if len(getattr(instances, name)) != k:
            return f"'{name}' has {len(getattr(instances, name))} rows for {k} instances"
    if len(instances.ids) not in (0, k):
        return f"'ids' has {len(instances.ids)} for {k} instances"
    steps = np.diff(instances.indices.astype(np.int64))
    is_inside = np.diff(instances.owners) == 0
    if (is_inside & (steps <= 0)).any():
        first = int(np.flatnonzero(is_inside & (steps <= 0))[0])
        return f"the mask of instance {instances.owner_at(first)} is not ascending, or holds a point twice"
    views = Masks(instances.view_indptr, instances.views[:, 0])
    if len(views) != k or not views.is_whole:
        return f"'view_indptr' does not describe {len(instances.views)} views of {k} instances"
    return None


def _fault_of_needs(needs: PerceptionNeeds) -> str | None:
    known = ("grounded", "class-agnostic", "none")
    if needs.masks not in known:
        return f"masks is {needs.masks!r}; {', '.join(map(repr, known[:-1]))} or 'none' is expected"
    is_ratios = isinstance(needs.crop_ratios, tuple) and all(
        isinstance(ratio, int | float) and ratio > 0 for ratio in needs.crop_ratios
    )
    return None if is_ratios else f"crop_ratios is {needs.crop_ratios!r}; a tuple of numbers above 0 is expected"
