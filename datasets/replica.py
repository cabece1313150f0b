"""Replica: NICE-SLAM's RGB-D render for input, the original release for ground truth."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from su3d_bench.datasets.replica_folders import (
    ORIGINAL_URL,
    RENDER_FOLDERS,
    RenderTree,
    find_original_scene,
    find_render_tree,
    no_render_tree,
    original_name,
    read_marker,
)
from su3d_bench.datasets.replica_frames import (
    ReplicaFrames,
    check_frames_complete,
    colour_name,
    depth_name,
    read_camera,
    read_trajectory,
)
from su3d_bench.datasets.replica_truth import (
    INFO_NAME,
    MESH_NAME,
    AnnotatedMesh,
    corner_truth,
    read_annotated_mesh,
    triangle_mesh,
    vertex_truth,
)
from su3d_bench.digests import digest_file
from su3d_bench.errors import DataError, GroundTruthMissing, suggest
from su3d_bench.types import Frame, GroundTruth, ImageDomain, InstanceMesh, SceneInfo

READER_VERSION = 1  # raise it whenever the same files come out as other frames or another truth


class ReplicaOptions(BaseModel):
    """Replica has no settings: its files say everything."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Replica:
    """NICE-SLAM's render of Replica, with ground truth from the original release; read below the data root."""

    name = "replica"
    label_space = "replica"
    variants: tuple[str, ...] = ("mesh-vertices", "face-corners", "conceptgraphs")
    Options = ReplicaOptions

    def __init__(self, root: Path, options: ReplicaOptions | None = None) -> None:
        self.root = root
        self.options = options or ReplicaOptions()
        self._mesh: tuple[str, AnnotatedMesh] | None = None

    @cached_property
    def tree(self) -> RenderTree:
        """The render tree; a ``DataError`` that says how to get data where there is none."""
        tree = find_render_tree(self.root)
        if tree is None:
            raise no_render_tree(self.root)
        return tree

    def scenes(self) -> Sequence[str]:
        """The official scenes that are here, in their order, then every other scene of the render tree."""
        return self.tree.scenes

    def places(self) -> Sequence[Path]:
        """Where the render tree is, or else would be looked for, in that order."""
        tree = find_render_tree(self.root)
        return [tree.folder] if tree is not None else [self.root / name for name in RENDER_FOLDERS]

    def status(self, scene: str) -> str:
        """A word on the scene from a quick look: poses and ground truth; ``info`` checks every file's presence."""
        try:
            n_poses = (self._folder(scene) / "traj.txt").read_bytes().rstrip().count(b"\n") + 1
        except OSError:
            return "traj.txt is missing"
        try:
            return f"{n_poses} frames, ground truth in {self._original(scene)}"
        except GroundTruthMissing as error:
            return f"{n_poses} frames, {str(error).partition(': ')[2]}"

    def info(self, scene: str, stride: int) -> SceneInfo:
        """Cheap facts and a check that the scene's frames are complete; the domain tells made scenes from scans."""
        folder = self._folder(scene)
        n_poses = len(read_trajectory(folder / "traj.txt", self._where(scene)))
        check_frames_complete(folder, n_poses, self._where(scene))
        return SceneInfo(self.name, scene, len(range(0, n_poses, stride)), stride, self._image_domain(scene))

    def frames(self, scene: str, stride: int) -> Sequence[Frame]:
        folder, where = self._folder(scene), self._where(scene)
        camera = read_camera(self.tree.folder / "cam_params.json", where)
        poses = read_trajectory(folder / "traj.txt", where)
        check_frames_complete(folder, len(poses), where)
        return ReplicaFrames(folder, where, camera, poses, range(0, len(poses), stride))

    def files(self, scene: str) -> Sequence[Path]:
        folder = self._folder(scene)
        n_poses = len(read_trajectory(folder / "traj.txt", self._where(scene)))
        images = [folder / name(index) for index in range(n_poses) for name in (colour_name, depth_name)]
        return (self.tree.folder / "cam_params.json", folder / "traj.txt", *images, *self._truth_files(scene))

    def digest(self, scene: str) -> str:
        """A key of the content of all small files and the mesh, of all frames' names and sizes, and of the content of
        the first and the last frame: a re-rendered frame in the middle that has the same size goes unseen."""
        folder = self._folder(scene)
        total = hashlib.sha256(f"replica {READER_VERSION} {scene} {self._image_domain(scene)}\n".encode())
        camera, trajectory = self.tree.folder / "cam_params.json", folder / "traj.txt"
        images = sorted(folder.glob("results/*"))
        try:
            for path in (camera, trajectory, *self._truth_files(scene), *images[:1], *images[-1:]):
                total.update(f"{path.name} {digest_file(path)}\n".encode())
            for path in images:
                total.update(f"{path.name} {path.stat().st_size}\n".encode())
        except OSError as error:
            raise DataError(f"{self._where(scene)}: {error.filename} cannot be read: {error.strerror}") from error
        return total.hexdigest()

    def ground_truth(self, scene: str, variant: str) -> GroundTruth:
        where = self._where(scene)
        if variant == "conceptgraphs":
            sequence = f"{original_name(scene)}/Sequence_1"
            raise GroundTruthMissing(
                f"{where}: ground truth 'conceptgraphs' is not read by this version; it takes the authors' clouds "
                f"({sequence}/traj_w_c.txt, {sequence}/saved-maps-gt/pointclouds/pc_*.h5) and a run's "
                f"({scene}/rgb_cloud/pointclouds/pc_points.h5); score under replica-mesh-ex6 instead"
            )
        makers = {"mesh-vertices": vertex_truth, "face-corners": corner_truth}
        if variant not in makers:
            hint = suggest(variant, self.variants) or f"; known: {', '.join(self.variants)}"
            raise GroundTruthMissing(f"{where}: no ground truth '{variant}'{hint}")
        return makers[variant](self._annotated_mesh(scene))

    def instance_mesh(self, scene: str) -> InstanceMesh:
        return triangle_mesh(self._annotated_mesh(scene))

    def _where(self, scene: str) -> str:
        return f"{self.name}/{scene}"

    def _folder(self, scene: str) -> Path:
        if scene not in self.tree.scenes:
            hint = suggest(scene, self.tree.scenes) or f"; {self.tree.folder} has {', '.join(self.tree.scenes[:8])}"
            raise DataError(f"replica: no scene '{scene}'{hint}")
        return self.tree.folder / scene

    def _image_domain(self, scene: str) -> ImageDomain:
        return "rendered-rooms" if scene in read_marker(self.tree.folder) else "camera"

    def _truth_files(self, scene: str) -> tuple[Path, ...]:
        original = find_original_scene(self.root, scene)
        names = (MESH_NAME, INFO_NAME)
        return () if original is None else tuple(original / name for name in names if (original / name).exists())

    def _annotated_mesh(self, scene: str) -> AnnotatedMesh:
        """The mesh of ``scene``; the last one is kept, because every protocol asks for it anew."""
        if self._mesh is None or self._mesh[0] != scene:
            self._folder(scene)
            self._mesh = scene, read_annotated_mesh(self._original(scene), self._where(scene))
        return self._mesh[1]

    def _original(self, scene: str) -> Path:
        """The scene's folder in the original release, with both files of the truth."""
        original, where = find_original_scene(self.root, scene), self._where(scene)
        if original is None:
            raise GroundTruthMissing(
                f"{where}: no ground truth; expected {original_name(scene)}/{MESH_NAME} of the original release "
                f"({ORIGINAL_URL}) in {self.root / 'replica_v1'}"
            )
        for name in (MESH_NAME, INFO_NAME):
            if not (original / name).exists():
                raise GroundTruthMissing(f"{where}: no ground truth; {original / name} is missing")
        return original
