"""What a program left in its output folder as a map: points of its own, or masks over the scan's vertices."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from su3d_bench.core.errors import PredictionError, printable
from su3d_bench.core.maps import Instances, Prediction
from su3d_bench.core.types import Surface
from su3d_bench.metrics.matching.nearest import masks_of_partition, select
from su3d_bench.metrics.protocols.loading import load_protocol, protocols_for
from su3d_bench.predictions.base import Content, ScenePrediction, VertexLabels, VertexMasks


def read_output(folder: Path, scene: str, format: str | None) -> ScenePrediction:
    """The only prediction in ``folder``, or the one of ``scene`` where there are several."""
    from su3d_bench.predictions.formats import recognise  # every format there is: not for a list of methods

    files = [path for path in folder.iterdir() if not path.name.startswith(".")]
    if not files:
        raise PredictionError("it ended without an error and left nothing in {output}")
    reader = recognise(folder, format)
    names = list(reader.scenes(folder))
    if not names:
        raise PredictionError(f"what it left in {{output}} has no prediction in the format {reader.name}")
    if len(names) > 1 and scene not in names:
        shown = printable(", ".join(names[:4]), 200)
        raise PredictionError(f"it left predictions of {len(names)} scenes ({shown}), none of them '{scene}'")
    return reader.read(folder, scene if scene in names else names[0])


def as_prediction(content: Content, surface: Surface | None, names: Mapping[int, str]) -> Prediction:
    """``content`` as a map; masks and labels without points stand on the vertices of ``surface``.

    ``names`` are those of the class numbers of such masks.
    """
    if not isinstance(content, VertexMasks | VertexLabels):
        return content
    if surface is None:
        raise PredictionError(
            "its masks have no points of their own and the dataset has no mesh; write points too, in another format"
        )
    n = len(surface.vertices)
    n_points = len(content.class_ids) if isinstance(content, VertexLabels) else content.n_points
    if n_points not in {None, n}:
        raise PredictionError(f"its masks are over {n_points} points, the mesh has {n} vertices; they must be the same")
    masks = _masks_of_labels(content) if isinstance(content, VertexLabels) else content
    return Instances.of(
        surface.vertices,
        masks,
        masks.scores,
        masks.features,
        labels=_labels(masks, names),
        names=tuple(printable(key, 200) for key in masks.keys),
        ids=range(1, len(masks) + 1),
    )


def _masks_of_labels(content: VertexLabels) -> VertexMasks:
    """One mask a class; ids of 0 and below are no class, nor are places in a list below 0."""
    distinct, row = np.unique(content.class_ids, return_inverse=True)
    is_class = distinct >= (content.numbering == "id")
    masks = select(masks_of_partition(row, len(distinct)), np.flatnonzero(is_class))
    kept = distinct[is_class].astype(np.int32)
    return VertexMasks(
        masks.indptr,
        masks.indices,
        n_points=len(content.class_ids),
        scores=np.ones(len(kept)),
        class_numbers=kept,
        numbering=content.numbering,
        keys=tuple(f"class {number}" for number in kept),
    )


def _labels(masks: VertexMasks, names: Mapping[int, str]) -> tuple[str, ...] | None:
    if masks.class_numbers is None:
        return None
    return tuple(names.get(number, f"class {number}") for number in masks.class_numbers.tolist())


def class_names(content: Content, dataset: str, protocol: str | None) -> dict[int, str]:
    """The names of the class numbers of ``content``: in ``protocol``, else in all that score the dataset by default.

    Empty where it has none. Raises ``PredictionError`` where the protocols give one number different names.
    """
    has_numbers = isinstance(content, VertexMasks) and content.class_numbers is not None and len(content) > 0
    if not (has_numbers or isinstance(content, VertexLabels)):
        return {}
    own = [load_protocol(protocol)] if protocol is not None else list(map(load_protocol, protocols_for(dataset)))
    own = [rules for rules in own if rules.classes]
    lists = [[(entry.id, entry.name) for entry in rules.classes] for rules in own]
    if isinstance(content, VertexMasks) and content.numbering == "index":
        scored = dict.fromkeys(tuple(entry.name for entry in rules.scored) for rules in own if rules.kind == "instance")
        lists = [list(enumerate(names)) for names in scored]
    elif isinstance(content, VertexMasks | VertexLabels) and content.numbering == "line":
        whole = dict.fromkeys(tuple(entry.name for entry in rules.classes) for rules in own)
        lists = [list(enumerate(names)) for names in whole]
    pairs = {pair for listed in lists for pair in listed}
    if not pairs or len(pairs) > len({number for number, _ in pairs}):
        known = ", ".join(rules.name for rules in own) or "any that has classes"
        raise PredictionError(f"whose are its class numbers? name a protocol in classes_of (known: {known})")
    return dict(pairs)
