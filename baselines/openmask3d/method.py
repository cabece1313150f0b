"""OpenMask3D: class-agnostic 3D proposals, each described by crops of the few views that show it best.

It is bound to its proposals: what no proposal covers is never found, what one merges stays merged.
"""

from __future__ import annotations

from collections.abc import Mapping

from su3d_bench.baselines.openmask3d.mask_pipeline import MaskPipeline, MaskPipelineConfig
from su3d_bench.core.interfaces import MethodAbout, SceneTools, StageTimer
from su3d_bench.core.types import Detections, Frame, Instances, PerceptionNeeds, SceneInfo


class OpenMask3DConfig(MaskPipelineConfig):
    """The settings of the original's ScanNet200 run; Mask3D's masks where ``proposals_folder`` names them."""


class OpenMask3D:
    """OpenMask3D: 3D proposals of Mask3D's kind, described by CLIP features of their five best views."""

    name = "openmask3d"
    Config: type[MaskPipelineConfig] = OpenMask3DConfig
    about = MethodAbout(
        paper="Takmaz et al.: OpenMask3D: Open-Vocabulary 3D Instance Segmentation, NeurIPS 2023",
        source="https://github.com/OpenMask3D/openmask3d, commit 3bc3fc5",
        licence="MIT",
        needs=("a mesh of the scan", "Mask3D's exported masks; without them weight-free proposals from the mesh"),
        status="projection, view selection, crops and means are tested on hand-worked values, its file formats on made "
        "files; segments equal those of ScanNet's program on made meshes; never run beside the original, and no figure "
        "of the paper has been reproduced",
    )

    def __init__(self, config: MaskPipelineConfig | None = None) -> None:
        self.config = config or OpenMask3DConfig()
        self._tools: SceneTools | None = None
        self._pipeline: MaskPipeline | None = None

    @property
    def needs(self) -> PerceptionNeeds:
        """No detections: it prompts for masks itself, where its proposals lie."""
        return PerceptionNeeds(masks="none", true_proposals=self.config.kind == "oracle")

    @property
    def caveat(self) -> str | None:
        return self.config.caveat

    @property
    def inputs(self) -> Mapping[str, str]:
        """Digest of the proposals' files."""
        return self.config.inputs

    @property
    def finish_costs(self) -> Mapping[str, float | int]:
        """Frames read again and views looked at by the last ``finish``."""
        return self._started.finish_costs

    @property
    def n_points(self) -> int:
        return len(self._started.proposals.points)

    @property
    def map_bytes(self) -> int:
        """What the proposals take: their points, masks and scores."""
        proposals = self._started.proposals
        arrays = (proposals.points, proposals.indptr, proposals.indices, proposals.scores)
        return sum(array.nbytes for array in arrays)

    @property
    def n_instances(self) -> int:
        return len(self._started.proposals)

    @property
    def _started(self) -> MaskPipeline:
        assert self._pipeline is not None, "start comes first"
        return self._pipeline

    def receive_tools(self, tools: SceneTools) -> None:
        """The frames to look at again, the mesh, and perception on demand."""
        self._tools = tools

    def start(self, scene: SceneInfo) -> None:
        """Makes or reads the proposals."""
        assert self._tools is not None, "the runner hands over tools before the start"
        self._pipeline = MaskPipeline(self.config, self._tools, scene)

    def update(self, frame: Frame, detections: Detections, timer: StageTimer) -> None:
        """Enters the frame among the views of the masks it shows; costs what the mesh and the masks are large."""
        self._started.update(frame, timer)

    def finish(self) -> Instances:
        """The proposals with features from their best views so far."""
        return self._started.finish()
