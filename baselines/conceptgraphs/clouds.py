"""The cloud of one object: voxel averages, its largest cluster, its bounding box.

Source: concept-graphs at commit 5c4da70, ``conceptgraph/slam/utils.py``, whose geometry is Open3D's.
"""

from __future__ import annotations

import numpy as np

from su3d_bench.core.types import BoolArray, Float64Array, Int64Array, OrientedBox

LEAST_CLUSTER = 5  # points; a smaller largest cluster is not trusted and the whole cloud stays
LEAST_FOR_ORIENTED_BOX = 4  # points that span a volume


def voxel_average(points: Float64Array, voxel_m: float) -> Float64Array:
    """The mean point (V, 3) of each occupied voxel, in the order of the voxels' first points.

    The grid starts half a voxel below the cloud's own minimum, as Open3D's ``voxel_down_sample`` has it: it moves with
    the cloud, so that a cloud averaged again is not left as it is.
    """
    if not len(points):
        return points
    from su3d_bench.baselines.conceptgraphs.kernels import means_of_cells

    averaged: Float64Array = means_of_cells(points, points.min(axis=0) - voxel_m / 2, voxel_m)
    return averaged


def density_clusters(points: Float64Array, eps_m: float, min_points: int) -> Int64Array:
    """DBSCAN's cluster (N,) of each point, -1 for none; the labels of Open3D's ``cluster_dbscan``."""
    from su3d_bench.numerics import clusters

    return clusters.density_clusters(points, eps_m, min_points, holds_eps=False)


def largest_cluster(points: Float64Array, eps_m: float, min_points: int) -> Float64Array:
    """The points of the largest DBSCAN cluster; all of them where there is none, or none of at least five points.

    Of clusters of equal size the one whose first point comes first, as Python's ``Counter`` counts them.
    """
    labels = density_clusters(points, eps_m, min_points)
    distinct, first, sizes = np.unique(labels[labels >= 0], return_index=True, return_counts=True)
    if not len(distinct) or sizes.max() < LEAST_CLUSTER:
        return points
    largest = np.flatnonzero(sizes == sizes.max())
    is_inside: BoolArray = labels == distinct[largest[np.argmin(first[largest])]]
    return points[is_inside]


def bounding_box(points: Float64Array, *, oriented: bool) -> OrientedBox:
    """The box around ``points``: along the principal axes of their convex hull, else along the world's axes."""
    if oriented and len(points) >= LEAST_FOR_ORIENTED_BOX:
        import open3d as o3d

        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        try:
            box = cloud.get_oriented_bounding_box(robust=True)
            return OrientedBox(np.array(box.center), np.array(box.extent), np.array(box.R))
        except RuntimeError:  # Qhull found no volume even in the jolted points
            pass
    low, high = points.min(axis=0), points.max(axis=0)
    return OrientedBox((low + high) / 2, high - low, np.eye(3))
