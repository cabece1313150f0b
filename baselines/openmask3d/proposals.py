"""Class-agnostic 3D proposals for methods that describe masks: from files, the mesh's shape, or ground truth.

Files are those of Mask3D, Segment3D and OpenMask3D, in any mask format that `evaluate` reads, processed as they do
before saving: connected parts, without small ones.

From the shape alone, without weights (ours; not Mask3D's): the mesh's segments (the dataset's, otherwise ScanNet's
algorithm) are merged into a tree; nodes whose border bends most, relative to its length,
become masks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from su3d_bench.baselines.mesh_segments.segments import MIN_VERTICES, THRESHOLD, mesh_segments
from su3d_bench.baselines.openmask3d.segment_tree import SegmentTree, contacts_of, is_within, merge_tree
from su3d_bench.core.digests import digest_file, digest_json
from su3d_bench.core.errors import DataError, PredictionError, shown
from su3d_bench.core.maps import Masks, Proposals
from su3d_bench.core.types import Float32Array, Float64Array, Int64Array, SceneInfo, Surface
from su3d_bench.metrics.matching.transfer import transfer_masks
from su3d_bench.predictions.base import VertexMasks

NOISE = -1


def split_into_parts(
    proposals: Proposals, eps_m: float, min_points: int, most_dropped: int, kept_share: float
) -> Proposals:
    """Each connected part of each mask as a mask with its score, best first, ties in order.

    Parts are DBSCAN's with ``eps_m`` and ``min_points``, without noise; those of at most ``most_dropped``
    points are dropped, and the first floor(``kept_share`` n) of the other n are kept.
    """
    parts: list[Int64Array] = []
    scores: list[float] = []
    for k in range(len(proposals)):
        members = proposals.mask(k)
        labels = density_clusters(proposals.points[members], eps_m, min_points)
        for label in range(int(labels.max(initial=NOISE)) + 1):
            part = members[labels == label].astype(np.int64)
            if len(part) > most_dropped:
                parts.append(part)
                scores.append(float(proposals.scores[k]))
    order = np.argsort(-np.array(scores), kind="stable")[: int(kept_share * len(scores))]
    masks = Masks.of_sets([parts[k] for k in order])
    return replace(proposals, indptr=masks.indptr, indices=masks.indices, scores=np.array(scores, np.float64)[order])


def voted_by_segments(proposals: Proposals, segments: Int64Array) -> Proposals:
    """Each mask made of whole segments: those of which it contains more than half, as both networks are evaluated.

    ``segments`` (N,) are numbered from 0, one per point; masks without more than half of any segment become empty.

    >>> points = np.zeros((5, 3), np.float32)
    >>> masks = Proposals(np.array([0, 3]), np.array([0, 1, 3]), points=points, scores=np.ones(1), source="made")
    >>> voted_by_segments(masks, np.array([0, 0, 0, 1, 1])).indices.tolist()
    [0, 1, 2]
    """
    size = np.bincount(segments)
    order = np.argsort(segments, kind="stable")
    start = np.cumsum(size) - size
    kept = []
    for k in range(len(proposals)):
        inside = np.bincount(segments[proposals.mask(k)], minlength=len(size))
        whole = np.flatnonzero(2 * inside > size)
        kept.append(np.sort(np.concatenate([order[:0], *(order[start[s] : start[s] + size[s]] for s in whole)])))
    masks = Masks.of_sets(kept)
    return replace(proposals, indptr=masks.indptr, indices=masks.indices)


def density_clusters(points: Float32Array, eps_m: float, min_points: int) -> Int64Array:
    """DBSCAN's label (N,) of each point, 0, 1, ... ordered by first point, -1 for noise."""
    if not len(points):
        return np.zeros(0, np.int64)
    if min_points <= 1:
        return linked_within(points.astype(np.float64), eps_m)
    from su3d_bench.numerics import clusters

    return clusters.density_clusters(points.astype(np.float64), eps_m, min_points)


def linked_within(points: Float64Array, gap_m: float) -> Int64Array:
    """The group (N,) of each point, linking points within ``gap_m`` of each other: DBSCAN with one point.

    DBSCAN itself lists all neighbours, quadratic in the number of points if ``gap_m`` spans a room. Here
    points are grouped in cubes of diagonal ``gap_m``, and two cubes are linked by their nearest points.
    """
    from scipy.spatial import cKDTree

    cells = np.floor((points - points.min(axis=0)) / (gap_m / np.sqrt(3))).astype(np.int64)
    distinct, cell_of = np.unique(cells, axis=0, return_inverse=True)
    cell_of = cell_of.reshape(-1)
    order = np.argsort(cell_of, kind="stable")
    members = np.split(order, np.cumsum(np.bincount(cell_of))[:-1])
    root = np.arange(len(distinct))

    def find(cell: int) -> int:
        while root[cell] != cell:
            root[cell] = root[root[cell]]
            cell = int(root[cell])
        return cell

    # cubes whose points may be within the gap lie at most two apart along each axis
    pairs = cKDTree(distinct).query_pairs(2, p=np.inf, output_type="ndarray")
    for a, b in pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]:
        low, high = sorted((find(int(a)), find(int(b))))
        if low != high:
            distances, _ = cKDTree(points[members[a]]).query(points[members[b]], distance_upper_bound=gap_m * 1.001)
            if (distances <= gap_m).any():
                root[high] = low
    roots = np.array([find(cell) for cell in range(len(distinct))])[cell_of]
    _, first, group = np.unique(roots, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[group.reshape(-1)]


def read_proposals(folder: Path, scene: str, surface: Surface) -> Proposals:
    """The masks of ``scene`` over the vertices of ``surface``, in file order; classes are ignored.

    Raises ``PredictionError`` if the files have no masks, cannot be used, or belong to another mesh.
    """
    from su3d_bench.predictions.formats import recognise  # imports every format: slow for a list of methods

    reader = recognise(folder)
    prediction = reader.read(folder, scene)
    masks, where = prediction.content, shown(prediction.path)
    if not isinstance(masks, VertexMasks):
        raise PredictionError(f"{where}: format '{reader.name}' has no masks over the mesh; use proposals that do")
    n_vertices = len(surface.vertices)
    if masks.n_points not in (None, n_vertices):
        raise PredictionError(
            f"{where}: proposals of {masks.n_points} points, but the mesh of '{scene}' has {n_vertices} vertices; use "
            "proposals created for this mesh"
        )
    source = f"{reader.name} in {where}"
    return Proposals(masks.indptr, masks.indices, points=surface.vertices, scores=masks.scores, source=source)


def digest_of_folder(folder: Path) -> str:
    """A key of the names and content of all files below ``folder``, which may be missing."""
    files: Mapping[str, Path] = {
        path.relative_to(folder).as_posix(): path for path in sorted(folder.rglob("*")) if path.is_file()
    }
    try:
        stats = {name: path.stat() for name, path in files.items()}
        return digest_json({name: _digest(files[name], stat.st_size, stat.st_mtime_ns) for name, stat in stats.items()})
    except OSError as error:
        raise PredictionError(f"{shown(folder)}: {error.filename} cannot be read: {error.strerror}") from error


@cache
def _digest(path: Path, size: int, changed_ns: int) -> str:
    """A key of the content; size and time decide whether it must be read again for the next scene."""
    return digest_file(path)


SOURCE = "geometric proposals from the mesh's shape, without a network"
# Surface area (square metres) above which size no longer counts for a part. Chosen on rooms/living0 and rooms/office0.
FULL_AREA_M2 = 0.5
MIN_BORDER = 0.2  # added to the relative border length, which is 0 for an isolated part
LONE_BEND = 0.3  # border bend of an isolated part


def segments_of(surface: Surface, threshold: float = THRESHOLD, min_vertices: int = MIN_VERTICES) -> Int64Array:
    """The segment (V,) of each vertex, numbered 0 to S - 1: published, otherwise by ScanNet's algorithm."""
    segments = surface.segments
    if segments is None:
        segments = mesh_segments(surface.vertices, surface.triangles, threshold, min_vertices)
    return np.unique(segments, return_inverse=True)[1].reshape(-1)


def surface_proposals(surface: Surface, row: Int64Array, config: ProposalConfig) -> Proposals:
    """The masks over the vertices of ``surface``, best first; ``row`` (V,) is the segment of each vertex."""
    tree = merge_tree(contacts_of(surface.vertices, surface.triangles, row))
    n_points = np.bincount(row, minlength=len(tree.leaves))
    scores = contrast(tree)
    nodes = chosen_nodes(tree, n_points, scores, config)
    rank = np.empty(len(tree.leaves), np.int64)
    rank[tree.leaves] = np.arange(len(tree.leaves))
    order = np.argsort(rank[row], kind="stable")  # vertices in the order of the leaves
    first = np.concatenate([[0], np.cumsum(n_points[tree.leaves])]).astype(np.int64)
    masks = Masks.of_sets([np.sort(order[first[tree.start[k]] : first[tree.end[k]]]) for k in nodes])
    return Proposals(masks.indptr, masks.indices, points=surface.vertices, scores=scores[nodes], source=SOURCE)


def contrast(tree: SegmentTree) -> Float64Array:
    """How much each node stands out (N,), about 0 to 1: mean bend of its border over the relative border length.

    The relative length is the number of contacts over the root of the number of patches; nodes below
    ``FULL_AREA_M2`` are weighted by the root of their area.
    """
    mean_bend = np.where(tree.n_contacts > 0, tree.bend / np.maximum(tree.n_contacts, 1), LONE_BEND)
    border = tree.n_contacts / np.sqrt(tree.n_patches)
    size = np.minimum(1.0, np.sqrt(tree.n_patches * tree.patch_m**2 / FULL_AREA_M2))
    result: Float64Array = mean_bend * size / (border + MIN_BORDER)
    return result


def chosen_nodes(tree: SegmentTree, n_points: Int64Array, scores: Float64Array, config: ProposalConfig) -> Int64Array:
    """The nodes that become masks, best first, ties in order; ``n_points`` (S,) of the segments.

    At most ``surface_max``, of ``surface_min_points`` vertices up to ``surface_max_share`` of all; of two nested ones
    whose IoU exceeds ``surface_duplicate_iou`` only the better one is kept.
    """
    before = np.concatenate([[0], np.cumsum(n_points[tree.leaves])])
    n_of_node = before[tree.end] - before[tree.start]
    fits = (n_of_node >= config.surface_min_points) & (n_of_node <= config.surface_max_share * before[-1])
    taken = np.zeros(0, np.int64)
    for node in np.argsort(-scores, kind="stable"):
        if len(taken) == config.surface_max:
            break
        smaller, larger = np.minimum(n_of_node[taken], n_of_node[node]), np.maximum(n_of_node[taken], n_of_node[node])
        is_same = is_within(tree, taken, int(node)) & (smaller > config.surface_duplicate_iou * larger)
        if fits[node] and not is_same.any():
            taken = np.append(taken, node)
    return taken


Kind = Literal["auto", "files", "surface", "oracle"]
Metres = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Share = Annotated[float, Field(gt=0, le=1)]


class ProposalConfig(BaseModel):
    """Source of proposals; the defaults are Mask3D's in OpenMask3D if the original has the setting.

    ``proposals``: ``files`` of ``proposals_folder``, ``surface`` for geometric ones from the mesh, ``oracle``
    for the ground truth's instances; ``auto`` uses files if a folder is set, otherwise the surface.
    ``split_parts``: the original's last step on its masks: connected parts, then whole segments by majority
    if ``segment_vote`` is on. Exports already include it, so it applies to ``surface`` only; ``always`` applies it
    to files too. Proposals from the ground truth are unchanged.
    """

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid")

    proposals: Kind = "auto"
    proposals_folder: Annotated[Path | None, Field(strict=False)] = None
    split_parts: Literal["surface", "always", "never"] = "surface"
    part_eps_m: Metres = 0.95  # general.dbscan_eps
    part_min_points: int = Field(default=1, ge=1)  # general.dbscan_min_points
    part_max_dropped: int = Field(default=0, ge=0)
    part_kept_share: Share = 1.0
    segment_vote: bool = True  # data.test.segments: off in the original's single-scene run
    # Ours, for proposals from the surface: as many as Mask3D has queries; at least what the evaluator counts.
    surface_max: int = Field(default=150, ge=1, le=100_000)
    surface_min_points: int = Field(default=100, ge=1)
    surface_max_share: Share = 0.25
    surface_duplicate_iou: Share = 0.5
    segment_threshold: Annotated[float, Field(gt=0, allow_inf_nan=False)] = THRESHOLD
    segment_min_vertices: int = Field(default=MIN_VERTICES, ge=1)

    @model_validator(mode="after")
    def _folder_fits(self) -> ProposalConfig:
        if self.proposals == "files" and self.proposals_folder is None:
            raise ValueError("proposals = 'files' needs proposals_folder, the folder of the masks")
        if self.proposals in ("surface", "oracle") and self.proposals_folder is not None:
            raise ValueError(f"proposals = '{self.proposals}' does not use proposals_folder; remove one of the two")
        return self

    @property
    def kind(self) -> Literal["files", "surface", "oracle"]:
        """``proposals`` with ``auto`` resolved."""
        if self.proposals != "auto":
            return self.proposals
        return "surface" if self.proposals_folder is None else "files"


def make_proposals(
    config: ProposalConfig, scene: SceneInfo, true_proposals: Callable[[], Proposals] | None
) -> Proposals:
    """The proposals of a scene over the vertices of its mesh, including empty masks if files have them."""
    kind, surface = config.kind, _surface(config, scene)
    if kind == "oracle":
        assert true_proposals is not None, "the runner passes true proposals to methods that need them"
        return _on_surface(true_proposals(), surface)
    if kind == "files":
        assert config.proposals_folder is not None
        proposals = read_proposals(config.proposals_folder, scene.scene, surface)
        return _in_parts(proposals, _segments(surface, config), config) if config.split_parts == "always" else proposals
    segments = _segments(surface, config)
    proposals = surface_proposals(surface, segments, config)
    return proposals if config.split_parts == "never" else _in_parts(proposals, segments, config)


def _segments(surface: Surface, config: ProposalConfig) -> Int64Array:
    return segments_of(surface, config.segment_threshold, config.segment_min_vertices)


def _in_parts(proposals: Proposals, segments: Int64Array, config: ProposalConfig) -> Proposals:
    parts = split_into_parts(
        proposals, config.part_eps_m, config.part_min_points, config.part_max_dropped, config.part_kept_share
    )
    return voted_by_segments(parts, segments) if config.segment_vote else parts


def _surface(config: ProposalConfig, scene: SceneInfo) -> Surface:
    where = f"{scene.dataset}/{scene.scene}"
    try:
        return scene.surface()
    except DataError as error:
        reason = str(error).removeprefix(f"{where}: ")
        raise DataError(f"{where}: proposals '{config.kind}' need the scan's mesh: {reason}") from error


def _on_surface(truth: Proposals, surface: Surface) -> Proposals:
    """The ground-truth instances on the vertices of ``surface``: each vertex uses its nearest labelled point."""
    masks = transfer_masks(truth.points, truth, surface.vertices)
    return replace(truth, points=surface.vertices, indptr=masks.indptr, indices=masks.indices)
