"""Class-agnostic 3D proposals for methods that describe masks: from files, from the mesh's shape, or from the truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from su3d_bench.baselines.mesh_segments.segments import MIN_VERTICES, THRESHOLD
from su3d_bench.baselines.openmask3d.components import split_into_parts, voted_by_segments
from su3d_bench.baselines.openmask3d.proposal_files import digest_of_folder, read_proposals
from su3d_bench.baselines.openmask3d.surface_proposals import SOURCE, NodeChoice, segments_of, surface_proposals
from su3d_bench.core.errors import DataError
from su3d_bench.core.interfaces import SceneTools
from su3d_bench.core.maps import Proposals
from su3d_bench.core.types import Int64Array, Surface
from su3d_bench.metrics.matching.nearest import transfer_masks

Kind = Literal["auto", "files", "surface", "oracle"]
Metres = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Share = Annotated[float, Field(gt=0, le=1)]


class ProposalConfig(BaseModel):
    """Where proposals come from; the defaults are Mask3D's in OpenMask3D, as far as the original has the setting.

    ``proposals``: ``files`` of ``proposals_folder``, ``surface`` for weight-free ones made from the mesh, ``oracle``
    for the truth's instances; ``auto`` takes files where a folder is set, else the surface.
    ``split_parts``: the original's last step on its masks: their connected parts, then whole segments by majority
    where ``segment_vote`` is on. Exports have gone through it, so it is done for ``surface`` alone; ``always`` does it
    for files, too. Proposals from the truth stay as they are.
    """

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid")

    proposals: Kind = "auto"
    proposals_folder: Annotated[Path | None, Field(strict=False)] = None
    split_parts: Literal["surface", "always", "never"] = "surface"
    part_eps_m: Metres = 0.95  # general.dbscan_eps
    part_min_points: int = Field(default=1, ge=1)  # general.dbscan_min_points
    part_most_dropped: int = Field(default=0, ge=0)
    part_kept_share: Share = 1.0
    segment_vote: bool = True  # data.test.segments: off in the original's single-scene run
    # Ours, for proposals from the surface: as many as Mask3D has queries; at least what the evaluator counts.
    surface_most: int = Field(default=150, ge=1, le=100_000)
    surface_min_points: int = Field(default=100, ge=1)
    surface_max_share: Share = 0.25
    surface_same_iou: Share = 0.5
    segment_threshold: Annotated[float, Field(gt=0, allow_inf_nan=False)] = THRESHOLD
    segment_min_vertices: int = Field(default=MIN_VERTICES, ge=1)

    @model_validator(mode="after")
    def _folder_fits(self) -> ProposalConfig:
        if self.proposals == "files" and self.proposals_folder is None:
            raise ValueError("proposals = 'files' needs proposals_folder, the folder of the masks")
        if self.proposals in ("surface", "oracle") and self.proposals_folder is not None:
            raise ValueError(f"proposals = '{self.proposals}' reads no proposals_folder; leave one of the two out")
        return self

    @property
    def kind(self) -> Literal["files", "surface", "oracle"]:
        """``proposals`` with ``auto`` resolved."""
        if self.proposals != "auto":
            return self.proposals
        return "surface" if self.proposals_folder is None else "files"

    @property
    def caveat(self) -> str | None:
        """What must be said beside numbers from these proposals."""
        return SOURCE if self.kind == "surface" else None

    @property
    def inputs(self) -> dict[str, str]:
        """Digest of the files, which are no part of the configuration."""
        return {"proposals": digest_of_folder(self.proposals_folder)} if self.proposals_folder is not None else {}


def make_proposals(config: ProposalConfig, tools: SceneTools, dataset: str, scene: str) -> Proposals:
    """The proposals of a scene over the vertices of its mesh, empty masks included where files have them."""
    kind, surface = config.kind, _surface(config, tools, f"{dataset}/{scene}")
    if kind == "oracle":
        return _true_proposals(tools, surface)
    if kind == "files":
        assert config.proposals_folder is not None
        proposals = read_proposals(config.proposals_folder, scene, surface)
        return _in_parts(proposals, _segments(surface, config), config) if config.split_parts == "always" else proposals
    choice = NodeChoice(
        config.surface_most, config.surface_min_points, config.surface_max_share, config.surface_same_iou
    )
    segments = _segments(surface, config)
    proposals = surface_proposals(surface, segments, choice)
    return proposals if config.split_parts == "never" else _in_parts(proposals, segments, config)


def _segments(surface: Surface, config: ProposalConfig) -> Int64Array:
    return segments_of(surface, config.segment_threshold, config.segment_min_vertices)


def _in_parts(proposals: Proposals, segments: Int64Array, config: ProposalConfig) -> Proposals:
    parts = split_into_parts(
        proposals, config.part_eps_m, config.part_min_points, config.part_most_dropped, config.part_kept_share
    )
    return voted_by_segments(parts, segments) if config.segment_vote else parts


def _surface(config: ProposalConfig, tools: SceneTools, where: str) -> Surface:
    try:
        return tools.surface()
    except DataError as error:
        reason = str(error).removeprefix(f"{where}: ")
        raise DataError(f"{where}: proposals '{config.kind}' lie on the scan's mesh: {reason}") from error


def _true_proposals(tools: SceneTools, surface: Surface) -> Proposals:
    """The truth's instances on the vertices of ``surface``: a vertex is in the masks of its nearest labelled point."""
    assert tools.true_proposals is not None, "the runner hands over true proposals to a method that needs them"
    truth = tools.true_proposals()
    masks = transfer_masks(truth.points, truth, surface.vertices)
    return replace(truth, points=surface.vertices, indptr=masks.indptr, indices=masks.indices)
