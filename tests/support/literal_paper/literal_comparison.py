"""What the pipeline's map and that of the paper's text differ in."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from literal_paper import NONE, Array, PaperProgram, Thing

from su3d_bench.core.maps import Instances

SAME_POINT_M = 1e-5  # maps are given in float32


def differences(found: Instances, program: PaperProgram) -> list[str]:
    """A line for each difference between a method's map and the paper's; empty where they are one.

    Two maps are one where they hold the same points, and the same sets of them with the same views, name, caption,
    feature, box, centroid and score. Which numbers the ids are is free, but each is one instance's.
    """
    things, of_none = program.things(), np.flatnonzero(program.scene.ids == NONE)
    kept = np.concatenate([of_none, *(thing.rows for thing in things)]).astype(int)
    row_of = matched(found.points, program.scene.points[kept])
    if row_of is None:
        return [f"map: {len(found.points)} points, the paper has {len(kept)}, or others"]
    if len(found) != len(things):
        return [f"instances: {len(found)}, the paper has {len(things)}"]
    place = np.full(len(program.scene.ids), NONE)
    place[kept] = row_of
    k_of = {found.mask(k).tobytes(): k for k in range(len(found))}
    masks = [np.sort(place[thing.rows]).astype(found.indices.dtype).tobytes() for thing in things]
    if {*k_of} != {*masks}:
        return ["instances: others than the paper's"]
    pairs = [(k_of[mask], thing) for mask, thing in zip(masks, things, strict=True)]
    lines = [f"instance {k}: {line}" for k, thing in pairs for line in unlike(found, k, thing)]
    if len({*found.ids.tolist()}) != len(found):
        lines.append(f"ids: {found.ids.tolist()} name an instance each")
    return lines


def matched(points: Array, others: Array) -> Array | None:
    """The row of ``points`` that each of ``others`` is, or None where they are not the same points."""
    from scipy.spatial import cKDTree

    if len(points) != len(others):
        return None
    if not len(points):
        return np.zeros(0, int)
    distance, rows = cKDTree(points).query(others)
    is_one = (distance < SAME_POINT_M).all() and len(np.unique(rows)) == len(rows)
    return np.asarray(rows) if is_one else None


def unlike(found: Instances, k: int, thing: Thing) -> Iterator[str]:
    """What instance ``k`` has otherwise than ``thing``, its points aside."""
    views = [tuple(view) for view in found.views[found.view_indptr[k] : found.view_indptr[k + 1]].tolist()]
    assert found.features is not None
    if views != thing.views:
        yield f"views {views}, the paper has {thing.views}"
    if (found.names[k], found.captions[k]) != (thing.name, thing.caption):
        yield f"'{found.names[k]}', '{found.captions[k]}', the paper has '{thing.name}', '{thing.caption}'"
    for what, ours, of_paper in (
        ("feature", found.features[k], thing.feature),
        ("box", found.boxes[k], thing.box),
        ("centroid", found.centroids[k], thing.centroid),
        ("score", found.scores[k], 1.0),
    ):
        if not np.allclose(ours, of_paper, rtol=1e-5, atol=1e-5):
            yield f"{what} {ours}, the paper has {of_paper}"
