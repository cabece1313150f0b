"""Scene graphs of FROSS: one pickle of all scenes, objects with points and classes, edges with shares of predicates.

Source: Merging/main.py of Howardkhh/FROSS at 645153b. Classes and predicates are numbers without names; what they are
called is told by how many there are: ReplicaSSG's list of Visual Genome, 150 and 50. Of equal scores the last counts,
as in its Merging/evaluate.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import PredictionError, printable, shown
from su3d_bench.core.files.unpacking import Allowance, UnpackingError
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import Float64Array
from su3d_bench.formats.arrays import MOST_MASKS, checked_points, kind_of
from su3d_bench.formats.pickles.pickles import read_pickle_file
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.relations import last_best
from su3d_bench.predictions.base import ONES, Reader, ScenePrediction, first_found, instances_of

START, SUFFIX = "predictions_", ".pkl"
LISTS = "replica-relations"  # the protocol with the lists by which numbers are named
FORGOTTEN = ("mean", "cov")
MOST_SCENES, MOST_EDGES = 10_000, 10_000_000


class Fross(Reader):
    name = "fross"
    summary = f"FROSS's {START}*{SUFFIX}: scene graphs of all scenes, with the classes and predicates of ReplicaSSG"
    noun = "scene graph"

    def recognise(self, path: Path) -> str | None:
        return f"it is or holds {START}*{SUFFIX}" if len(_files(path)) == 1 else None

    def scenes(self, path: Path) -> Mapping[str, Path]:
        files = _files(path)
        if len(files) > 1:
            raise PredictionError(f"{shown(path)}: has {len(files)} files {START}*{SUFFIX}; give one of them")
        return {scene: file for file in files for scene in _content(file)}

    def read_scene(self, place: Path, scene: str) -> ScenePrediction:
        where = f"{shown(place)}: {printable(scene, 80)}"
        graph = _content(place)[scene]
        clouds = graph.get("pcd") if isinstance(graph, dict) else None
        allowance = Allowance(place.stat().st_size)
        try:  # objects that share their points cost the file a few bytes and memory for each
            for cloud in clouds if isinstance(clouds, list) else ():
                allowance.spend(4 * cloud.size if isinstance(cloud, np.ndarray) else 0)
        except UnpackingError as error:
            raise PredictionError(f"{where}: {error}") from error
        instances = scene_graph(graph, load_protocol(LISTS), where)
        return ScenePrediction(scene, self.name, place, instances, (ONES,))


def scene_graph(graph: object, rules: ProtocolRules, where: str) -> Instances:
    """The map of one scene of the file, its numbers named by the classes and predicates of ``rules``."""
    if not isinstance(graph, dict):
        raise PredictionError(f"{where}: is {kind_of(graph)}; expected a scene graph with pcd, cls and edges")
    clouds = graph.get("pcd")
    if not isinstance(clouds, list) or len(clouds) > MOST_MASKS:
        raise PredictionError(f"{where}: 'pcd' is {kind_of(clouds)}; expected a list of points an object")
    k = len(clouds)
    classes = _table(graph.get("cls"), (k, len(rules.classes)), f"{where}: 'cls'")
    edges = _edges(graph.get("edge_index"), k, f"{where}: 'edge_index'")
    scores = _table(graph.get("edge_cls"), (len(edges), len(rules.predicates)), f"{where}: 'edge_cls'")
    labels = tuple(rules.classes[place].name for place in last_best(classes).tolist())
    points = [checked_points(cloud, f"{where}: object {row}") for row, cloud in enumerate(clouds)]
    instances = instances_of(
        points, where, features=None, labels=labels, names=labels, captions=("",) * k, ids=range(k)
    )
    return replace(instances, edges=edges, edge_scores=scores, predicates=rules.predicates)


def _files(path: Path) -> list[Path]:
    if path.is_file():
        return [path] if path.name.startswith(START) and path.name.endswith(SUFFIX) else []
    return [file for file in first_found(path, [f"{START}*{SUFFIX}", f"*/{START}*{SUFFIX}"]) if file.is_file()]


def _content(file: Path) -> dict[str, Any]:
    value = read_pickle_file(file, forget=FORGOTTEN)
    if not isinstance(value, dict) or not value or len(value) > MOST_SCENES:
        raise PredictionError(f"{shown(file)}: holds {kind_of(value)}; expected the scene graph of each scene")
    if not all(isinstance(scene, str) for scene in value):
        raise PredictionError(f"{shown(file)}: has a scene that is no name; expected the scene graph of each scene")
    return value


def _table(value: object, shape: tuple[int, int], where: str) -> Float64Array:
    """A table of scores; without rows whatever is empty will do."""
    if not shape[0] and _is_empty(value):
        return np.zeros(shape)
    if not isinstance(value, np.ndarray) or value.shape != shape or value.dtype.kind not in "fiu":
        raise PredictionError(f"{where} is {kind_of(value)}; expected {shape[0]} rows of {shape[1]}, as ReplicaSSG has")
    with np.errstate(over="ignore"):
        scores: Float64Array = value.astype(np.float64)
    if not np.isfinite(scores).all():
        raise PredictionError(f"{where} has values that are NaN or infinite")
    return scores


def _edges(value: object, n_objects: int, where: str) -> NDArray[np.int32]:
    """Rows of subject and object (E, 2) of the file's (2, E)."""
    if _is_empty(value):
        return np.zeros((0, 2), np.int32)
    is_table = isinstance(value, np.ndarray) and value.ndim == 2 and len(value) == 2 and value.dtype.kind in "iu"
    if not isinstance(value, np.ndarray) or not is_table or value.shape[1] > MOST_EDGES:
        raise PredictionError(f"{where} is {kind_of(value)}; expected rows of subjects and of objects")
    if not 0 <= int(value.min()) <= int(value.max()) < n_objects:
        raise PredictionError(f"{where} names object {int(value.max())}; the scene graph has {n_objects}")
    return np.ascontiguousarray(value.T).astype(np.int32)


def _is_empty(value: object) -> bool:
    return (isinstance(value, np.ndarray) and not value.size) or (isinstance(value, list) and not value)
