"""Maps of ConceptGraphs: gzipped pickles of objects, each with its own points and one CLIP feature.

Source: concept-graphs at commit 5c4da70 (``pcd_saves/full_pcd_*.pkl.gz``, with ``_post`` after its last merging) and
branch ali-dev at dc00a8a (``exps/<suffix>/pcd_<suffix>.pkl.gz``, with ``edges``, without ``bg_objects``).

Scene graphs of FROSS: one pickle of all scenes, objects with points and classes, edges with shares of predicates.
Source: Merging/main.py of Howardkhh/FROSS at 645153b. Classes and predicates are numbers without names; the names
follow from their number: ReplicaSSG's list of Visual Genome, 150 and 50. On equal scores the last one counts, as in
its Merging/evaluate.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import PredictionError, printable, shown
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import Float32Array, Float64Array
from su3d_bench.formats import arrays
from su3d_bench.formats.pickles import read_pickle_file
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.relations import last_best
from su3d_bench.predictions.base import ONES, Parsed, first_found, instances_of, named_once

SUFFIX = ".pkl.gz"
POST = f"_post{SUFFIX}"
FULL, STREAMLINED = f"full_pcd_*{SUFFIX}", f"pcd_*{SUFFIX}"
SKIPPED_FIELDS = ("mask", "pcd_color_np")  # the masks of every view are most of the file
NAME_OF_NONE = "item"  # the name of every object in the class-agnostic variant
MAX_TEXT = 1000
GRAPHS = "predictions_*.pkl"  # FROSS's
LISTS = "replica-relations"  # the protocol with the lists that name its numbers
SKIPPED_GRAPH_FIELDS = ("mean", "cov")
MAX_SCENES, MAX_EDGES = 10_000, 10_000_000


def looks_like_conceptgraphs(path: Path) -> str | None:
    if path.is_file():
        is_map = path.name.endswith(SUFFIX) and path.name.startswith(("full_pcd_", "pcd_"))
        return "its name is that of a map of ConceptGraphs" if is_map else None
    return f"it contains {FULL} or {STREAMLINED}" if _maps(path) else None


def conceptgraphs_scenes(path: Path) -> Mapping[str, Path]:
    if path.is_file():
        return {_scene_of(path): path}
    of_folder: dict[Path, list[Path]] = {}
    for file in _maps(path):
        of_folder.setdefault(file.parent, []).append(file)
    return named_once([(_scene_of(files[0]), _chosen(files)) for files in of_folder.values()], path)


def conceptgraphs(place: Path, scene: str) -> Parsed:
    where, remarks = shown(place), [ONES]
    if place.name.endswith(POST) and place.with_name(place.name.removesuffix(POST) + SUFFIX).exists():
        remarks.append(f"'{printable(place.name, 120)}' is read, not the map before the last merging next to it")
    value = read_pickle_file(place, forget=SKIPPED_FIELDS)
    if not isinstance(value, dict) or not isinstance(value.get("objects"), list):
        raise PredictionError(f"{where}: holds {arrays.kind_of(value)} without a list of 'objects'; expected a map")
    background = _background(value.get("bg_objects"), where)
    entries = [entry for entry in (*value["objects"], *background) if isinstance(entry, dict)]
    _check_sum([entry.get(key) for entry in entries for key in ("pcd_np", "clip_ft", "class_id")], place)
    instances, more = _instances(value["objects"], background, _class_names(value.get("class_names")), where)
    return instances, (*remarks, *more)


def _check_sum(values: Sequence[Any], file: Path) -> None:
    """Rejects objects that share arrays: a few bytes in the file could cost memory and time for each object."""
    sizes = [np.size(value) if isinstance(value, np.ndarray) else len(value) for value in values if _is_many(value)]
    arrays.check_memory(4 * sum(sizes), file)


def _is_many(value: object) -> bool:
    return isinstance(value, np.ndarray | list | tuple)


def _maps(path: Path) -> list[Path]:
    """The map files of one scene or several, for ``path`` at any level of the layout."""
    full = [f"{above}{FULL}" for above in ("", "pcd_saves/", "*/pcd_saves/")]
    streamlined = [f"{above}{STREAMLINED}" for above in ("", "*/", "exps/*/", "*/exps/*/")]
    return [file for file in first_found(path, [*full, *streamlined]) if file.is_file()]


def _scene_of(file: Path) -> str:
    """The folder above ``pcd_saves`` or ``exps``, otherwise the name of the file."""
    above = file.absolute().parents
    if above[0].name == "pcd_saves" and above[1].name:
        return above[1].name
    if len(above) > 2 and above[1].name == "exps" and above[2].name:
        return above[2].name
    return file.name.removesuffix(SUFFIX)


def _chosen(files: Sequence[Path]) -> Path:
    """The only map of a folder, or of two the one after the last merging."""
    if len(files) == 1 or [file.name for file in files[1:]] == [files[0].name.removesuffix(SUFFIX) + POST]:
        return files[-1]
    names = printable(", ".join(file.name for file in files), 200)
    raise PredictionError(f"{shown(files[0].parent)}: contains {len(files)} maps ({names}); give one of these files")


def _class_names(value: object) -> tuple[str, ...]:
    """The list of class names; empty if there is none."""
    texts = value.tolist() if isinstance(value, np.ndarray) and value.dtype.kind == "U" else value
    if not isinstance(texts, list | tuple):
        return ()
    return tuple(printable(text[:MAX_TEXT], 80) if isinstance(text, str) else "" for text in texts[: arrays.MAX_MASKS])


def _instances(
    objects: list[Any], background: list[Any], class_names: Sequence[str], where: str
) -> tuple[Instances, list[str]]:
    """The objects, then the background objects, which have their own names as labels.

    This is the original's evaluation if it excludes only 'other' (``n_exclude`` 1). With 4 or 6 excluded classes it
    does not load them; here they are then excluded because their names are among the excluded ones.
    """
    everything = [*objects, *background]
    if len(everything) > arrays.MAX_MASKS:
        raise PredictionError(f"{where}: contains {len(everything)} objects; is it damaged?")
    clouds, names, captions = [], [], []
    for k, entry in enumerate(everything):
        at = f"{where}: object {k}"
        if not isinstance(entry, dict) or "pcd_np" not in entry:
            raise PredictionError(f"{at}: is {arrays.kind_of(entry)} without 'pcd_np'; expected a ConceptGraphs object")
        clouds.append(arrays.checked_points(entry["pcd_np"], at))
        names.append(_name(entry, _majority(entry.get("class_id")), class_names))
        caption = entry.get("consolidated_caption")
        captions.append(printable(caption[:MAX_TEXT], MAX_TEXT) if isinstance(caption, str) else "")
    features, remarks = _features(objects, where)
    if features is not None and any(name != NAME_OF_NONE for name in names[: len(objects)]):
        remarks.append(
            "names are those of most detections; the feature of an object decides its class, as in the original"
        )
    walls = tuple(name.lower() for name in names[len(objects) :])
    own = tuple(names[: len(objects)]) if features is None else ("",) * len(objects)
    if background:
        which = printable(", ".join(dict.fromkeys(walls)), 80)
        remarks.append(
            f"{len(background)} background objects ({which}) have their own names as labels and count only where "
            "these classes are scored, as in the original's evaluation"
        )
        if features is not None:
            features = np.concatenate([features, _rows_like(background, features.shape[1])])
    has_labels = bool(background) or (features is None and len(objects) > 0)
    instances = instances_of(
        clouds,
        where,
        features,
        labels=(*own, *walls) if has_labels else None,
        names=tuple(names),
        captions=tuple(captions),
        ids=range(len(everything)),
    )
    return instances, remarks


def _rows_like(background: Sequence[Mapping[str, Any]], n: int) -> Float32Array:
    """The features (K, n) of background objects, zeros if one has none of that length; labels have priority."""
    rows = np.zeros((len(background), n), np.float32)
    for k, entry in enumerate(background):
        row = entry.get("clip_ft")
        if isinstance(row, np.ndarray) and row.shape == (n,) and row.dtype.kind == "f" and np.isfinite(row).all():
            rows[k] = arrays.as_float32(row)
    rows[~np.isfinite(rows).all(axis=1)] = 0
    return rows


def _majority(value: object) -> int | None:
    """The most frequent class number of the detections, the lowest on ties, as in the original."""
    numbers = value.tolist() if isinstance(value, np.ndarray) and value.ndim == 1 else value
    if not isinstance(numbers, list | tuple):
        return None
    whole = [int(number) for number in numbers if isinstance(number, int | np.integer) and abs(int(number)) < 1 << 31]
    if not whole:
        return None
    values, counts = np.unique(np.array(whole, np.int64), return_counts=True)
    return int(values[np.argmax(counts)])


def _name(entry: Mapping[str, Any], number: int | None, class_names: Sequence[str]) -> str:
    """The name of class ``number``, otherwise the object's own."""
    if number is not None and 0 <= number < len(class_names) and class_names[number]:
        return class_names[number]
    name = entry.get("class_name")
    name = name[0] if isinstance(name, list) and name else name
    return printable(name[:MAX_TEXT], 80) if isinstance(name, str) and name.strip() else NAME_OF_NONE


def _features(objects: Sequence[Mapping[str, Any]], where: str) -> tuple[Float32Array | None, list[str]]:
    """The features (K, D) of the objects; None if no object has one."""
    rows_of_file = [entry.get("clip_ft") for entry in objects]
    if not any(entry is not None for entry in rows_of_file):
        remark = "the objects have no 'clip_ft': the names of their detections decide their classes"
        return None, [remark] * bool(rows_of_file)
    rows: list[Float32Array] = []
    for k, row in enumerate(rows_of_file):
        beside = f" of {len(rows[0])} numbers, as in object 0" if rows else ""
        found = f"{where}: object {k}: 'clip_ft' is"
        rows.append(
            arrays.as_float32(
                arrays.array_of(row, found, f"a list{beside}", "f", len(rows[0]) if rows else arrays.NOT_EMPTY)
            )
        )
    features, remarks = arrays.without_nonfinite(np.stack(rows), "objects")
    return features, list(remarks)


def _background(value: object, where: str) -> list[Any]:
    """Walls, floor and ceiling, which the Detect variant stores separately; a class never seen is None there."""
    if value is not None and not isinstance(value, list):
        raise PredictionError(f"{where}: 'bg_objects' is {arrays.kind_of(value)}; expected a list")
    return [entry for entry in value or () if entry is not None]


# ---- FROSS


def looks_like_fross(path: Path) -> str | None:
    return f"it is or contains {GRAPHS}" if len(_graph_files(path)) == 1 else None


def fross_scenes(path: Path) -> Mapping[str, Path]:
    files = _graph_files(path)
    if len(files) > 1:
        raise PredictionError(f"{shown(path)}: has {len(files)} files {GRAPHS}; give one of them")
    return {scene: file for file in files for scene in _graphs(file)}


def fross(place: Path, scene: str) -> Parsed:
    graph = _graphs(place)[scene]
    clouds = graph.get("pcd") if isinstance(graph, dict) else None
    _check_sum(clouds if isinstance(clouds, list) else [], place)
    return scene_graph(graph, load_protocol(LISTS), f"{shown(place)}: {printable(scene, 80)}"), [ONES]


def scene_graph(graph: object, rules: ProtocolRules, where: str) -> Instances:
    """The map of one scene of the file, with the class and predicate names of ``rules``."""
    if not isinstance(graph, dict):
        raise PredictionError(f"{where}: is {arrays.kind_of(graph)}; expected a scene graph with pcd, cls and edges")
    clouds = graph.get("pcd")
    if not isinstance(clouds, list) or len(clouds) > arrays.MAX_MASKS:
        raise PredictionError(f"{where}: 'pcd' is {arrays.kind_of(clouds)}; expected one list of points per object")
    k = len(clouds)
    classes = _table(graph.get("cls"), (k, len(rules.classes)), f"{where}: 'cls'")
    edges = _edges(graph.get("edge_index"), k, f"{where}: 'edge_index'")
    scores = _table(graph.get("edge_cls"), (len(edges), len(rules.predicates)), f"{where}: 'edge_cls'")
    labels = tuple(rules.classes[place].name for place in last_best(classes).tolist())
    points = [arrays.checked_points(cloud, f"{where}: object {row}") for row, cloud in enumerate(clouds)]
    instances = instances_of(points, where, None, labels=labels, names=labels, ids=range(k))
    return replace(instances, edges=edges, edge_scores=scores, predicates=rules.predicates)


def _graph_files(path: Path) -> list[Path]:
    if path.is_file():
        return [path] if path.match(GRAPHS) else []
    return [file for file in first_found(path, [f"{GRAPHS}", f"*/{GRAPHS}"]) if file.is_file()]


def _graphs(file: Path) -> dict[str, Any]:
    value = read_pickle_file(file, forget=SKIPPED_GRAPH_FIELDS)
    if not isinstance(value, dict) or not value or len(value) > MAX_SCENES:
        raise PredictionError(f"{shown(file)}: holds {arrays.kind_of(value)}; expected the scene graph of each scene")
    if not all(isinstance(scene, str) for scene in value):
        raise PredictionError(
            f"{shown(file)}: has a scene key that is not a name; expected the scene graph of each scene"
        )
    return value


def _table(value: object, shape: tuple[int, int], where: str) -> Float64Array:
    """A table of scores; without rows any empty value is accepted."""
    if not shape[0] and _is_empty(value):
        return np.zeros(shape)
    expected = f"{shape[0]} rows of {shape[1]}, as in ReplicaSSG"
    scores: Float64Array = arrays.array_of(value, f"{where} is", expected, "fiu", *shape).astype(np.float64)
    if not np.isfinite(scores).all():
        raise PredictionError(f"{where} has values that are NaN or infinite")
    return scores


def _edges(value: object, n_objects: int, where: str) -> NDArray[np.int32]:
    """Rows of subject and object (E, 2) of the file's (2, E)."""
    if _is_empty(value):
        return np.zeros((0, 2), np.int32)
    table = arrays.array_of(value, f"{where} is", "rows of subjects and of objects", "iu", 2, None)
    if table.shape[1] > MAX_EDGES or not 0 <= int(table.min()) <= int(table.max()) < n_objects:
        raise PredictionError(f"{where} names object {int(table.max())}; the scene graph has {n_objects}")
    return np.ascontiguousarray(table.T).astype(np.int32)


def _is_empty(value: object) -> bool:
    return (isinstance(value, np.ndarray) and not value.size) or (isinstance(value, list) and not value)
