"""OpenLex3D's ground truth: the labels and queries of its release with the points of the base data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.digests import digest_file, digest_json
from su3d_bench.core.errors import GroundTruthMissing
from su3d_bench.datasets.openlex3d.labels import (
    CATEGORIES_NAME,
    PROMPTS_NAME,
    QUERY_LEVEL,
    VISIBLE_NAME,
    Level,
    OpenLexFiles,
    queries_name,
)
from su3d_bench.datasets.openlex3d.points import SAMPLED_DATASET, LabelledPoints, points_of, sampled_points_file
from su3d_bench.metrics.matching.nearest import nearest
from su3d_bench.metrics.open_vocabulary.openlex3d import SPACE as LABELS
from su3d_bench.metrics.open_vocabulary.openlex3d import OpenLexTruth
from su3d_bench.metrics.open_vocabulary.query_ap import SPACE as QUERIES
from su3d_bench.metrics.open_vocabulary.query_ap import QueryTruth

DATASETS = ("replica", "scannetpp", "hm3d")  # as the release calls them, and below the data root their own data
ALL_SEEN = ("scannetpp", "hm3d")  # whose scenes may have no cloud of visible points: all that the base data has counts
VISIBLE_RADIUS_M = 0.05  # how far the labelled point may be that says to which object a visible point belongs
VISIBLE, FACE_CORNERS = "openlex3d-visible", "openlex3d-face-corners"
FURTHER_TRUTHS: Mapping[str, str] = {LABELS: VISIBLE, QUERIES: FACE_CORNERS}  # label space -> ground truth
RELEASE_FOLDER = "gt_openlex3d"
PLACES = (RELEASE_FOLDER, f"openlex3d/{RELEASE_FOLDER}", f"OpenLex3D/{RELEASE_FOLDER}", "openlex3d", "OpenLex3D")
PAGE = "https://github.com/openlex3d/openlex3d"


def categories_truth(files: OpenLexFiles, labelled: LabelledPoints) -> OpenLexTruth:
    """The truth of ``openlex3d-topn`` and ``openlex3d-ranking``: visible points with the objects of the nearest point.

    One without a labelled point nearer than 5 cm has no object. Without a cloud of visible points a scene of
    ``ALL_SEEN`` is scored on all labelled points, as the original does.
    """
    if files.dataset in ALL_SEEN and not files.has_visible_points:
        points, objects, name = labelled.points, labelled.object_of_point, "all points"
    else:
        points, name = files.visible_points(), VISIBLE_NAME
        distance, nearest_rows = nearest(labelled.points, points, VISIBLE_RADIUS_M)
        nearest_rows[distance >= VISIBLE_RADIUS_M] = -1
        objects = np.append(labelled.object_of_point, -1)[nearest_rows]
    return OpenLexTruth(
        points,
        objects,
        files.objects(),
        files.prompts(),
        VISIBLE,
        f"{name}, {CATEGORIES_NAME} and {PROMPTS_NAME} of OpenLex3D, objects from {labelled.source}",
    )


def queries_truth(files: OpenLexFiles, labelled: LabelledPoints, level: Level) -> QueryTruth:
    """The truth of ``openlex3d-queries``: all points with their objects, seen or not."""
    return QueryTruth(
        labelled.points,
        labelled.object_of_point,
        files.queries(level),
        FACE_CORNERS,
        f"{queries_name(level)} of OpenLex3D, objects from {labelled.source}",
    )


@dataclass(frozen=True)
class OpenLexRelease:
    """The labels of ``dataset`` in the release below ``folder``, and its base data below ``data_root``."""

    folder: Path
    data_root: Path
    dataset: str

    @staticmethod
    def datasets_at(folder: Path) -> tuple[str, ...]:
        """The datasets whose labels a folder of ground truth has; none where it is not the release."""
        return tuple(name for name in DATASETS if (folder / name / PROMPTS_NAME).is_file())

    def scenes(self) -> tuple[str, ...]:
        """The scenes with labels, in alphabetical order."""
        return tuple(sorted(path.parent.name for path in (self.folder / self.dataset).glob(f"*/{CATEGORIES_NAME}")))

    def digest(self, scene: str) -> str:
        """A key of the labels and queries of a scene; the points are those of the base data."""
        files = [self.folder / self.dataset / PROMPTS_NAME, *sorted((self.folder / self.dataset / scene).iterdir())]
        return digest_json({file.name: digest_file(file) for file in files if file.is_file()})

    def truth(self, scene: str, variant: str) -> OpenLexTruth | QueryTruth:
        """The truth of a scene; ``GroundTruthMissing`` where one of its files is not there."""
        files = OpenLexFiles(self.folder, self.dataset, scene)
        labelled = _kept_points(self.dataset, self.data_root, scene)
        if variant == VISIBLE:
            return categories_truth(files, labelled)
        return queries_truth(files, labelled, QUERY_LEVEL)


def label_files(root: Path, dataset: str, scene: str) -> tuple[Path, ...]:
    """The files of a scene's labels below the data root, sampled points too; none where the release is not there."""
    found = _find(root, dataset, scene)
    if found is None:
        return ()
    release, name = found
    folder = release.folder / dataset
    labels = sorted(path for path in (folder / name).iterdir() if path.is_file())
    points = sampled_points_file(root, name) if dataset == SAMPLED_DATASET else None
    return (folder / PROMPTS_NAME, *labels, *(() if points is None else (points,)))


def truth_below(root: Path, dataset: str, scene: str, variant: str) -> Any:
    """The truth of a dataset's scene, from the release and the base data below the data root.

    An ``OpenLexTruth`` or a ``QueryTruth``, as ``variant`` says; neither is a ``GroundTruth``.
    """
    found = _find(root, dataset, scene)
    if found is None:
        raise GroundTruthMissing(
            f"{dataset}/{scene}: no ground truth '{variant}'; expected {RELEASE_FOLDER}/{dataset}/{_names(scene)[-1]}/"
            f"{CATEGORIES_NAME} of OpenLex3D ({PAGE}) in {root}"
        )
    release, name = found
    return release.truth(name, variant)


def _find(root: Path, dataset: str, scene: str) -> tuple[OpenLexRelease, str] | None:
    """The release below ``root`` with the labels of a scene, and what that calls it."""
    for place in PLACES:
        for name in _names(scene):
            if (root / place / dataset / name / CATEGORIES_NAME).is_file():
                return OpenLexRelease(root / place, root, dataset), name
    return None


def _names(scene: str) -> tuple[str, ...]:
    """What the release may call a scene: of HM3D's walks the number before the hyphen."""
    return tuple(dict.fromkeys((scene, scene.partition("-")[0])))


@lru_cache(maxsize=1)
def _kept_points(dataset: str, data_root: Path, scene: str) -> LabelledPoints:
    """The points of a scene; the last ones are kept, because every protocol asks for them anew."""
    return points_of(dataset, data_root, scene)
