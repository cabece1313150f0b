"""The ground truth as a prediction: it yields the ground-truth ceiling of every protocol."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pydantic import BaseModel, ConfigDict

from su3d_bench.core.interfaces import MethodAbout, StageTimer
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import Detections, Frame, GroundTruth, Int32Array, PerceptionNeeds, SceneInfo, TrueGraph
from su3d_bench.perception.embedded.lexicon import scene_caption


class Oracle:
    """Returns the ground truth as a map: one mask per instance, labelled with its class, score 1."""

    name = "oracle"
    is_system = False
    keeps_ids = True
    about = MethodAbout(
        paper="",
        source="",
        licence="that of this project",
        needs=("ground truth",),
        status="scores 1 if a protocol allows it; otherwise less, which a method may exceed",
    )

    class Config(BaseModel):
        model_config = ConfigDict(extra="forbid", frozen=True)

    def __init__(self, config: Config) -> None:
        self.config = config
        self._truth: GroundTruth | None = None

    @property
    def needs(self) -> PerceptionNeeds:
        """Nothing: frames are not used."""
        return PerceptionNeeds(frames=False)

    def receive_ground_truth(self, truth: GroundTruth) -> None:
        """Take the ground truth; only the runner calls this, and only for this method."""
        self._truth = truth

    def start(self, scene: SceneInfo) -> None:
        assert self._truth is not None, f"{scene.dataset}/{scene.scene}: the oracle was started without ground truth"

    def update(self, frame: Frame, detections: Detections, timer: StageTimer) -> None:
        """Does nothing: the oracle does not use frames."""

    def finish(self) -> Instances:
        """The points of the ground truth; those of no instance stay in the map, outside all masks."""
        truth = self._truth
        assert truth is not None
        masks = {key: mask for key, mask in _masks_of(truth).items() if truth.semantic[mask[0]] > 0}
        labels = tuple(truth.labels.name_of(int(truth.semantic[mask[0]])) for mask in masks.values())
        found = Instances.of(
            truth.points,
            list(masks.values()),
            labels=labels,
            names=labels,
            captions=tuple(scene_caption(label) for label in labels),
            ids=list(masks),
        )
        found = replace(found, places=truth.places)
        return found if truth.graph is None else _with_graph(found, truth.graph)


def _with_graph(instances: Instances, graph: TrueGraph) -> Instances:
    """The map with the annotated relations of its objects as edges; only the first of several between two counts."""
    row_of = {int(key): row for row, key in enumerate(instances.ids)}
    kept = [one for one in graph.relations if one[0] in row_of and one[2] in row_of]
    names = tuple(dict.fromkeys(predicate for _, predicate, _ in kept)) or ("none",)
    edges = np.array([(row_of[subject], row_of[other]) for subject, _, other in kept], np.int32).reshape(-1, 2)
    scores = np.array([[float(name == predicate) for name in names] for _, predicate, _ in kept], np.float64)
    return replace(instances, edges=edges, edge_scores=scores.reshape(-1, len(names)), predicates=names)


def _masks_of(truth: GroundTruth) -> dict[int, Int32Array]:
    """Instance id -> indices of its points, ascending; all points of an instance have one class.

    Points excluded from evaluation (class -1) are omitted.
    """
    order = np.argsort(truth.instance, kind="stable")
    order = order[truth.semantic[order] >= 0]
    ids, starts = np.unique(truth.instance[order], return_index=True)
    parts = np.split(order.astype(np.int32), starts[1:])
    return {int(key): part for key, part in zip(ids, parts, strict=True) if key > 0}
