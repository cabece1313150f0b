"""Labels of made scenes in OpenLex3D's own files: ``gt_openlex3d/<dataset>/`` with prompts, labels in tiers, queries.

Synonyms of a class are what the rooms, ScanNet, ScanNet++ and HM3DSem call it; visually similar are the names of other
classes of its type (OpenScan's, as the rooms have it); clutter is what it stands on, in or beside, or bears. Nothing in
the rooms depicts a thing that has a name. Files are those of the release and of dataset_generation/ of openlex3d at
commit 3dbad2b.
"""

from __future__ import annotations

import io
import pickle
import zipfile
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.files.atomic import make_folder, write_bytes, write_json
from su3d_bench.core.types import Float32Array, Float64Array, Int64Array
from su3d_bench.datasets.hm3dsem.categories import category_of
from su3d_bench.datasets.openlex3d.labels import CATEGORIES_NAME, LEVELS, PROMPTS_NAME, VISIBLE_NAME, queries_name
from su3d_bench.datasets.openlex3d.points import SAMPLED_OBJECTS, SAMPLED_POINTS
from su3d_bench.datasets.openlex3d.release import RELEASE_FOLDER
from su3d_bench.datasets.rooms.attributes import classes_of_type
from su3d_bench.datasets.rooms.classes import CLASSES
from su3d_bench.datasets.scannet.writing.categories import categories as scannet_categories
from su3d_bench.datasets.scannetpp.writing.categories import words as scannetpp_words
from su3d_bench.datasets.writing import ScannedObject, write_shared_text
from su3d_bench.formats.pcd import write_pcd_points
from su3d_bench.metrics.open_vocabulary.openlex3d import ObjectLabels, bare
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.numerics.relations import Relations

STAGED = ".openlex3d"
ZIP_EPOCH = (1980, 1, 1, 0, 0, 0)


def labels_folder(out: Path, dataset: str, scene: str) -> Path:
    """Where the labels of a scene stand."""
    return out / RELEASE_FOLDER / dataset / scene


@cache
def synonyms(class_name: str) -> tuple[str, ...]:
    """What a class is called, the rooms' own name first; each name once, however it is spaced.

    >>> synonyms("tv-screen")
    ('tv screen', 'tv')
    """
    names = (
        class_name.replace("-", " "),
        scannet_categories()[class_name].raw_category,
        scannetpp_words()[class_name],
        category_of(class_name),
    )
    return tuple({bare(name): name for name in reversed(names)}[key] for key in dict.fromkeys(map(bare, names)))


@cache
def similar(class_name: str) -> tuple[str, ...]:
    """The names of what is of the type of a class, and none of its own."""
    others = [name for other in classes_of_type(class_name) for name in synonyms(other)]
    own = {bare(name) for name in synonyms(class_name)}
    return tuple(dict.fromkeys(name for name in others if bare(name) not in own))


def labels_of(objects: Sequence[ScannedObject]) -> dict[int, ObjectLabels]:
    """The labels of each object by its id; clutter may be any of ``objects``."""
    boxes = np.array([(known.box_min, known.box_max) for known in objects], np.float64)
    close: dict[int, dict[int, None]] = {known.id: {} for known in objects}
    for link in Relations(boxes, [known.class_name.rpartition("-")[2] for known in objects]).links():
        if link.relation != "above":
            close[objects[link.subject].id][objects[link.object].id] = None
    names = {known.id: known.class_name for known in objects}
    return {
        key: ObjectLabels(synonyms(name), (), similar(name), tuple(sorted(close[key]))) for key, name in names.items()
    }


def write_prompts(out: Path, dataset: str) -> None:
    """The list among which a method may choose: every label that an object of any room may have."""
    names = {name for known in CLASSES for name in (*synonyms(known.name), *similar(known.name))}
    folder = out / RELEASE_FOLDER / dataset
    make_folder(folder)
    text = "".join(f"{name}\n" for name in sorted(names))
    write_shared_text(folder / PROMPTS_NAME, text, "is another list than that of the rooms")


def write_labels(
    folder: Path,
    scene: str,
    objects: Sequence[ScannedObject],
    numbers: Mapping[int, int],
    visible: Float32Array | None = None,
) -> None:
    """The files of a scene. ``numbers``: of each object that has points, how the base data number it.

    ``visible`` (N, 3): the points that its images show; None where all that the base data have count.
    """
    make_folder(folder)
    labels = labels_of([known for known in objects if known.id in numbers])
    samples = [_sample(numbers[key], one, numbers) for key, one in labels.items()]
    write_json(folder / CATEGORIES_NAME, {"dataset": {"name": scene, "samples": samples}})
    left_out = {bare(name) for name in load_protocol("openlex3d-topn").ignore}
    level0: dict[str, list[int]] = {}
    for key, one in labels.items():
        for name in one.synonyms:
            if bare(name) not in left_out:
                level0.setdefault(name, []).append(numbers[key])
    queries: dict[str, Any] = {"level0": level0, "level1": {}}
    for level in LEVELS:
        content = queries if level == "all" else {f"level{level[1:]}": queries[f"level{level[1:]}"]}
        write_json(folder / queries_name(level), content)
    if visible is not None:
        write_pcd_points(folder / VISIBLE_NAME, visible)


def _sample(number: int, labels: ObjectLabels, numbers: Mapping[int, int]) -> dict[str, Any]:
    tiers = {
        "synonyms": list(labels.synonyms),
        "depictions": list(labels.depictions),
        "vis_sim": list(labels.vis_sim),
        "clutter": [str(numbers[other]) for other in labels.clutter],  # the release has some of them as texts
    }
    return {"object_id": number, "labels": {"image_attributes": tiers}}


def write_sampled_points(path: Path, scene: str, points: Float64Array, objects: Int64Array) -> None:
    """Points (N, 3) with objects (N,) in the form in which ScanNet++'s toolbox keeps what it samples (torch.save)."""
    content = {
        "scene_id": scene,
        SAMPLED_POINTS: np.ascontiguousarray(points, np.float64),
        SAMPLED_OBJECTS: objects.astype(np.int16),
    }
    parts = {"data.pkl": pickle.dumps(content, protocol=2), "byteorder": b"little", "version": b"3\n"}
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, part in parts.items():
            archive.writestr(zipfile.ZipInfo(f"{scene}/{name}", date_time=ZIP_EPOCH), part)
    make_folder(path.parent)
    write_bytes(path, buffer.getvalue())
