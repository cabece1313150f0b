"""ConceptGraphs' ground truth of Replica: a fused cloud with one label a point, scored on the points of another cloud.

- The *labelled cloud* is Semantic-NeRF's ``Sequence_1`` fused by gradslam with one-hot labels; the authors share it.
  Its poses are relative to the first frame, so the first pose of ``traj_w_c.txt`` brings it to the world.
- The *reference cloud* is gradslam's fusion of NICE-SLAM's render by ``run_slam_rgb.py``, which every user makes for
  himself. It is fused with absolute poses, so its points are in the world already and are taken as they are.

Source: conceptgraph/scripts/eval_replica_semseg.py and run_slam_rgb.py at commit 5c4da70 of concept-graphs.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import Float32Array, GroundTruth
from su3d_bench.datasets.recordings.meshes import check_finite
from su3d_bench.datasets.replica.folders import FUSED_CLOUD, replica_label_set
from su3d_bench.formats.hdf5 import largest_column, read_rows
from su3d_bench.formats.poses import moved, read_first_pose

N_EMBEDDING = 102  # channel i is Replica's class i, 0 is 'other'
TRAJECTORY_NAME = "traj_w_c.txt"


def cloud_files(sequence: Path) -> tuple[Path, ...]:
    """The files of the labelled cloud that are read."""
    clouds = sequence / FUSED_CLOUD
    return sequence / TRAJECTORY_NAME, clouds / "pc_points.h5", clouds / "pc_embeddings.h5"


def conceptgraphs_truth(sequence: Path, reference: Path, where: str) -> GroundTruth:
    """The labelled cloud in the world, and the reference cloud as the points to be scored; no instances.

    The label of a point is the argmax of its 102 channels, the first maximum: a row of zeros is 'other', id 0.
    """
    trajectory, points_file, labels_file = cloud_files(sequence)
    first_pose = read_first_pose(trajectory, f"{where}: {sequence.name}/{trajectory.name}")
    points = read_points(points_file, f"{where}: {FUSED_CLOUD}/{points_file.name}")
    labels_where = f"{where}: {FUSED_CLOUD}/{labels_file.name}"
    labels = largest_column(labels_file, N_EMBEDDING, labels_where)
    if len(labels) != len(points):
        raise DataError(
            f"{labels_where}: has {len(labels)} rows, {points_file.name} has {len(points)}; both must be of one cloud"
        )
    return GroundTruth(
        moved(points, first_pose),
        labels,
        np.zeros(len(points), np.int32),
        replica_label_set(),
        "conceptgraphs",
        f"{sequence.parent.name}/{sequence.name}/{FUSED_CLOUD}, moved by the first pose of {TRAJECTORY_NAME}; scored "
        f"on the points of {'/'.join(reference.parts[-4:])}",
        evaluation_points=read_points(reference, f"{where}: {'/'.join(reference.parts[-3:])}"),
    )


def read_points(path: Path, where: str) -> Float32Array:
    """The finite points (N, 3) of a ``pc_points.h5``, at least one."""
    points = read_rows(path, 3, where)
    check_finite(points, where, "point")
    if not len(points):
        raise DataError(f"{where}: holds no point; make or copy it again")
    return points
