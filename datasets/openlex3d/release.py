"""OpenLex3D's ground truth: the labels and queries of its release with the points of the base data."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from su3d_bench.core.digests import digest_file, digest_json
from su3d_bench.datasets.openlex3d.labels import (
    CATEGORIES_NAME,
    PROMPTS_NAME,
    QUERY_LEVEL,
    VISIBLE_NAME,
    Level,
    OpenLexFiles,
    queries_name,
)
from su3d_bench.datasets.openlex3d.points import LabelledPoints, points_of
from su3d_bench.metrics.matching.nearest import nearest
from su3d_bench.metrics.open_vocabulary.openlex3d import OpenLexTruth
from su3d_bench.metrics.open_vocabulary.query_ap import QueryTruth

DATASETS = ("replica", "scannetpp", "hm3d")  # as the release calls them, and below the data root their own data
ALL_SEEN = ("scannetpp", "hm3d")  # whose scenes may have no cloud of visible points: all that the base data has counts
VISIBLE_RADIUS_M = 0.05  # how far the labelled point may be that says to which object a visible point belongs
VISIBLE, FACE_CORNERS = "openlex3d-visible", "openlex3d-face-corners"


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


@lru_cache(maxsize=1)
def _kept_points(dataset: str, data_root: Path, scene: str) -> LabelledPoints:
    """The points of a scene; the last ones are kept, because every protocol asks for them anew."""
    return points_of(dataset, data_root, scene)
