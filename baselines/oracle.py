"""The ground truth itself through the same evaluation steps: the ceiling of every protocol."""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, ConfigDict

from su3d_bench.perception.naming import scene_caption
from su3d_bench.types import (
    Detections,
    Frame,
    InstanceMesh,
    Instances,
    Int32Array,
    PerceptionNeeds,
    SceneInfo,
    StageTimer,
)


class Oracle:
    """Hands back the annotated mesh as a map: one mask an instance, labelled with its class, scored 1."""

    name = "oracle"

    class Config(BaseModel):
        model_config = ConfigDict(extra="forbid", frozen=True)

    def __init__(self, config: Config) -> None:
        self.config = config
        self._mesh: InstanceMesh | None = None

    @property
    def needs(self) -> PerceptionNeeds:
        """Nothing: no frame is looked at."""
        return PerceptionNeeds(frames=False)

    def receive_truth(self, mesh: InstanceMesh) -> None:
        """Take the truth; only the runner calls this, and only for this method."""
        self._mesh = mesh

    def start(self, scene: SceneInfo) -> None:
        assert self._mesh is not None, f"{scene.dataset}/{scene.scene}: the oracle was started without the truth"

    def update(self, frame: Frame, detections: Detections, timer: StageTimer) -> None:
        """Frames tell the oracle nothing."""

    def finish(self) -> Instances:
        """The mesh vertices as points; a vertex on the border of two instances belongs to both."""
        mesh = self._mesh
        assert mesh is not None
        ids = [key for key in sorted(mesh.class_of_instance) if np.any(mesh.instance_of_triangle == key)]
        masks = [_vertices_of(mesh, key) for key in ids]
        labels = tuple(mesh.labels.name_of(mesh.class_of_instance[key]) for key in ids)
        corners = [mesh.vertices[mask] for mask in masks]
        k = len(ids)
        return Instances(
            points=mesh.vertices,
            indptr=np.concatenate([[0], np.cumsum([len(mask) for mask in masks])]).astype(np.int64),
            indices=np.concatenate(masks) if k else np.zeros(0, np.int32),
            scores=np.ones(k, np.float64),
            features=None,
            labels=labels,
            names=labels,
            captions=tuple(scene_caption(label) for label in labels),
            boxes=np.array([[c.min(axis=0), c.max(axis=0)] for c in corners], np.float32).reshape(k, 2, 3),
            centroids=np.array([c.mean(axis=0, dtype=np.float64) for c in corners], np.float32).reshape(k, 3),
            view_indptr=np.zeros(k + 1, np.int64),
            views=np.zeros((0, 2), np.int32),
            ids=np.array(ids, np.int32),
        )


def _vertices_of(mesh: InstanceMesh, instance: int) -> Int32Array:
    return np.unique(mesh.triangles[mesh.instance_of_triangle == instance]).astype(np.int32)
