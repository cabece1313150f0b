"""Which object of the ground truth an instance of a map stands for: the one that it covers most of all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from su3d_bench.core.types import GroundTruth, Instances, Int64Array, Partition
from su3d_bench.metrics.instance import average_precision as instance_ap
from su3d_bench.metrics.matching import nearest as transfer
from su3d_bench.metrics.protocols import TransferRules

NO_OBJECT = 0


@dataclass(frozen=True)
class Covered:
    """``n_shared`` (K, O): truth vertices of object ``object_ids`` (O,) that instance k covers.

    A vertex is covered by the instances that own the map point nearest to it, where that is within the cap.
    """

    object_ids: Int64Array
    n_shared: Int64Array

    @property
    def main_object(self) -> Int64Array:
        """The object (K,) that each instance covers most vertices of, the lowest id of equals, 0 where it covers none.

        >>> Covered(np.array([3, 7]), np.array([[2, 5], [4, 4], [0, 0]])).main_object.tolist()
        [7, 3, 0]
        """
        if not len(self.object_ids):
            return np.full(len(self.n_shared), NO_OBJECT, np.int64)
        best = self.n_shared.argmax(axis=1)
        return np.where(self.n_shared.max(axis=1) > 0, self.object_ids[best], NO_OBJECT)


def covered_objects(rules: TransferRules, truth: GroundTruth, prediction: Instances | Partition) -> Covered:
    """What each instance, or row of features, covers of the truth's objects."""
    if isinstance(prediction, Instances):
        masks = transfer.masks_of(prediction)
    else:
        masks = transfer.masks_of_partition(prediction.instance, len(prediction.features))
    moved = transfer.transfer_masks(prediction.points, masks, truth.points, rules.cap_m, rules.evaluation_voxel_m)
    ids, column = np.unique(np.maximum(truth.instance, 0), return_inverse=True)
    shared = instance_ap.intersections(column, len(ids), moved.indptr, moved.indices, np.arange(len(masks)))
    is_object = ids > 0
    return Covered(ids[is_object].astype(np.int64), shared[:, is_object])
