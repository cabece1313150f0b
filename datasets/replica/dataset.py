"""Replica: frames from NICE-SLAM's RGB-D render, ground truth from the original release."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path

from su3d_bench.core.errors import DataError, FramesMissing, GroundTruthMissing, counted, suggest
from su3d_bench.core.types import Frame, GroundTruth, ImageDomain, InstanceMesh, OrientedBox, Surface
from su3d_bench.datasets.openlex3d import release as openlex3d
from su3d_bench.datasets.recordings.file_dataset import FileDataset, NoOptions, keeps_last, read_marker
from su3d_bench.datasets.recordings.meshes import read_surface
from su3d_bench.datasets.recordings.source import missing_parts
from su3d_bench.datasets.replica import checks, folders, frames, scene_graphs, truth

CAMERA = "cam_params.json"


class Replica(FileDataset[NoOptions]):
    """NICE-SLAM's render of Replica, with ground truth from the original release; read below the data root."""

    name = "replica"
    headline_protocol = "replica-conceptgraphs-ex6"  # reported by most papers: reports/tables/published.toml
    reader_version = 4
    reads_made_rooms = True
    scene_names = r"(room_?[0-2]|office_?[0-4])"  # including those of generated rooms
    label_space = "replica"
    variants = (
        "mesh-vertices", "face-corners", "conceptgraphs", "openmask3d", "ovo-51", "boxes", scene_graphs.VARIANT
    )  # fmt: skip
    extra_ground_truths = openlex3d.EXTRA_GROUND_TRUTHS
    labels_of = "replica"
    Options = NoOptions

    @cached_property
    def rendered(self) -> folders.RenderTree:
        """The render tree, with no scenes if there is none."""
        return folders.find_render_tree(self.root) or folders.RenderTree(self.root / folders.RENDER_FOLDERS[0], ())

    def scenes(self) -> Sequence[str]:
        """The official scenes that are available, in their order, then all other scenes of the render tree.

        Without a render tree, those of the original release, which can be viewed; otherwise these only work by name.
        """
        scenes = self.rendered.scenes or folders.unrendered_scenes(self.root)
        if not scenes:
            raise folders.no_render_tree(self.root)
        return scenes

    def places(self) -> Sequence[Path]:
        """Where the render tree is, or would be looked for, in that order."""
        tree = folders.find_render_tree(self.root)
        return [tree.folder] if tree is not None else [self.root / name for name in folders.RENDER_FOLDERS]

    def status(self, scene: str) -> str:
        """One-line summary of the scene from a quick look: poses, ground truth; ``info`` checks that files exist."""
        n_frames = "no frames"
        if self._is_rendered(scene):
            folder = self.folder(scene)
            if fault := missing_parts(folder, "traj.txt", "results") or missing_parts(folder.parent, CAMERA):
                return fault
            n_frames = counted(len(frames.trajectory_lines(folder / "traj.txt", self.where(scene))), "frame")
        try:
            words = f"ground truth in {self._original(scene)}"
        except GroundTruthMissing as error:
            words = str(error).partition(": ")[2]
            original = folders.find_original_scene(self.root, scene)
            if original is not None and (original / truth.INFO_NAME).exists():
                mesh = original / truth.MESH_NAME
                words = f"{len(self.object_boxes(scene))} boxes of objects, no mesh ({mesh} is missing)"
        released = []
        for variant, files in self._released_truths(scene).items():
            missing = [path.name for path in files if not path.exists()]
            released += [f"{variant} without its {missing[0]}" if missing else variant] if files else []
        return f"{n_frames}, {words}" + (f"; also {', '.join(released)}" if released else "")

    def n_frames(self, scene: str, stride: int) -> int:
        """A cheap count that also checks that the scene's frames are complete."""
        folder = self.folder(scene)
        if not self._is_rendered(scene):
            return 0
        n_poses = len(frames.read_trajectory(folder / "traj.txt", self.where(scene)))
        frames.check_frames_complete(folder, n_poses, self.where(scene))
        return len(range(0, n_poses, stride))

    def image_domain(self, scene: str) -> ImageDomain:
        return "rendered-rooms" if scene in read_marker(self.rendered.folder) else "camera"

    def frames(self, scene: str, stride: int) -> Sequence[Frame]:
        folder, where = self.folder(scene), self.where(scene)
        if not self._is_rendered(scene):
            raise FramesMissing(
                f"{where}: no frames; expected traj.txt and results/ of NICE-SLAM's render in {folder}: "
                f"{folders.FETCH_FRAMES}; to view the available files: su3d-bench datasets show {where}"
            )
        camera = frames.read_camera(self.rendered.folder / CAMERA, where)
        poses = frames.read_trajectory(folder / "traj.txt", where)
        frames.check_frames_complete(folder, len(poses), where)
        return frames.ReplicaFrames(folder, where, camera, poses, range(0, len(poses), stride))

    def recording_files(self, scene: str) -> Sequence[Path]:
        folder = self.folder(scene)
        if not self._is_rendered(scene):
            return ()
        n_poses = len(frames.read_trajectory(folder / "traj.txt", self.where(scene)))
        images = [folder / name(index) for index in range(n_poses) for name in (frames.colour_name, frames.depth_name)]
        return (self.rendered.folder / CAMERA, folder / "traj.txt", *images)

    def recording_key(self, scene: str) -> str:
        """A key of the content of every file; see ``image_key`` for what it does not detect in an image."""
        folder = self.folder(scene)
        files = (self.rendered.folder / CAMERA, folder / "traj.txt") if self._is_rendered(scene) else ()
        return checks.digest_of(files, sorted(folder.glob("results/*")), self.where(scene))

    def problems(self, scene: str) -> Iterator[str]:
        """Faults in the scene's files, one line each; objects without entry are void, not faults."""
        self.folder(scene)
        if self._is_rendered(scene):
            yield from checks.render_problems(self.rendered.folder, scene, self.where(scene))
        yield from checks.original_problems(folders.find_original_scene(self.root, scene), self.where(scene))

    def own_truth(self, scene: str, variant: str) -> GroundTruth:
        match variant:
            case "mesh-vertices":
                return truth.vertex_truth(self._annotated_mesh(scene))
            case "face-corners":
                return truth.corner_truth(self._annotated_mesh(scene))
            case "conceptgraphs":
                return self._cloud_truth(scene)
            case "openmask3d" | "ovo-51":
                return self._label_file_truth(scene, variant)
            case "replicassg":
                return scene_graphs.graph_truth(self.root, scene, self._annotated_mesh(scene), self.where(scene))
            case "boxes":
                return checks.box_truth(checks.object_boxes_of(self._info(scene), self.where(scene)))
        raise AssertionError(variant)

    def object_boxes(self, scene: str) -> Mapping[int, OrientedBox]:
        """Object id of the original release -> its box in the world, from ``info_semantic.json`` alone."""
        return checks.boxes_of(truth.read_info(self._info(scene), self.where(scene)), self.where(scene))

    def _info(self, scene: str) -> Path:
        self.folder(scene)
        original = folders.find_original_scene(self.root, scene)
        if original is None or not (original / truth.INFO_NAME).exists():
            raise GroundTruthMissing(
                f"{self.where(scene)}: no boxes of objects; expected {folders.original_name(scene)}/{truth.INFO_NAME} "
                f"of the original release in {self.root / 'replica_v1'}: {folders.FETCH_MESHES}"
            )
        return original / truth.INFO_NAME

    def instance_mesh(self, scene: str) -> InstanceMesh:
        return truth.triangle_mesh(self._annotated_mesh(scene))

    def surface(self, scene: str) -> Surface:
        """The mesh next to the render, whose vertices the label files for OpenMask3D and OVO describe."""
        self.folder(scene)
        mesh = self._render_mesh(scene)
        if not mesh.exists():
            raise DataError(f"{self.where(scene)}: no mesh; {mesh.name} is missing in {self.rendered.folder}")
        return read_surface(mesh, f"{self.where(scene)}: {mesh.name}")

    def _render_mesh(self, scene: str) -> Path:
        return self.rendered.folder / f"{scene}_mesh.ply"

    def folder(self, scene: str) -> Path:
        """Path of the scene's render, existing or not; a ``DataError`` if nothing of the scene exists."""
        if not self._is_rendered(scene) and not self._is_annotated(scene):
            known = self.scenes()
            hint = suggest(scene, known, f"{self.rendered.folder} has")
            raise DataError(f"replica: no scene '{scene}'{hint}")
        return self.rendered.folder / scene

    def _is_annotated(self, scene: str) -> bool:
        original = folders.find_original_scene(self.root, scene) if re.fullmatch(r"\w[\w-]*", scene, re.ASCII) else None
        return original is not None and any((original / name).is_file() for name in (truth.MESH_NAME, truth.INFO_NAME))

    def _is_rendered(self, scene: str) -> bool:
        return scene in self.rendered.scenes

    def small_files(self, scene: str) -> tuple[Path, ...]:
        """The render's mesh and every available ground-truth file, of any variant."""
        original = folders.find_original_scene(self.root, scene)
        names = (truth.MESH_NAME, truth.INFO_NAME)
        paths = [self._render_mesh(scene)] + ([] if original is None else [original / name for name in names])
        released = self._released_truths(scene)
        paths += [path for files in released.values() for path in files]
        if released["openmask3d"] or released["ovo-51"]:
            paths += self._labelled_meshes(scene).values()
        return tuple(path for path in dict.fromkeys(paths) if path.exists())

    def _released_truths(self, scene: str) -> dict[str, tuple[Path, ...]]:
        """Variant -> its files, for ground truth released by others than Replica's authors; empty if none."""
        sequence = folders.find_semantic_sequence(self.root, scene)
        reference = self.folder(scene) / folders.REFERENCE_CLOUD
        clouds = () if sequence is None else (*truth.cloud_files(sequence), reference)
        labels = {variant: self._label_file(scene, variant) for variant in ("openmask3d", "ovo-51")}
        graphs = scene_graphs.find_graph_folder(self.root)
        of_graph = () if graphs is None else tuple(graphs / name for name in scene_graphs.FILES)
        lex = openlex3d.label_files(self.root, self.name, scene)
        return {"conceptgraphs": clouds, scene_graphs.VARIANT: of_graph, "openlex3d": lex} | {
            variant: () if path is None else (path,) for variant, path in labels.items()
        }

    def _label_file(self, scene: str, variant: str) -> Path | None:
        if variant == "openmask3d":
            return folders.find_label_file(self.root, scene, folders.INSTANCE_FOLDERS, "instance_labels_")
        return folders.find_label_file(self.root, scene, folders.SEMANTIC_LABEL_FOLDERS, "semantic_labels_")

    def _labelled_meshes(self, scene: str) -> dict[str, Path]:
        """The meshes whose vertices a label file may describe; first that of the render, which the authors used."""
        original, render = folders.find_original_scene(self.root, scene), self._render_mesh(scene)
        meshes = {render.name: render} | ({} if original is None else {truth.MESH_NAME: original / truth.MESH_NAME})
        return {name: path for name, path in meshes.items() if path.exists()}

    def _label_file_truth(self, scene: str, variant: str) -> GroundTruth:
        path, where = self._label_file(scene, variant), self.where(scene)
        if path is None:
            folder = folders.INSTANCE_FOLDERS[0] if variant == "openmask3d" else folders.SEMANTIC_LABEL_FOLDERS[0]
            raise GroundTruthMissing(
                f"{where}: no ground truth '{variant}'; expected {folder}/{scene}.txt, one label per vertex, in "
                f"{self.rendered.folder}; {folders.HOW_TO_GET_LABELS[variant]}"
            )
        make = truth.instance_file_truth if variant == "openmask3d" else truth.class_file_truth
        return make(path, self._labelled_meshes(scene), where)

    def _cloud_truth(self, scene: str) -> GroundTruth:
        where, sequence = self.where(scene), folders.find_semantic_sequence(self.root, scene)
        reference = self.folder(scene) / folders.REFERENCE_CLOUD
        if sequence is None:
            expected = f"{folders.original_name(scene)}/Sequence_1/{folders.FUSED_CLOUD}"
            raise GroundTruthMissing(
                f"{where}: no ground truth 'conceptgraphs'; expected {expected} of its authors ({folders.CLOUDS_URL}) "
                f"in {self.root / folders.SEMANTIC_FOLDERS[0]}; replica-mesh-ex6 works without it"
            )
        if not reference.exists():
            raise GroundTruthMissing(
                f"{where}: no ground truth 'conceptgraphs'; the points to be scored, {folders.REFERENCE_CLOUD}, are "
                f"missing in {reference.parents[2]}; make them with ConceptGraphs' run_slam_rgb.py (stride 5, 480x640)"
            )
        return truth.conceptgraphs_truth(sequence, reference, where)

    @keeps_last
    def _annotated_mesh(self, scene: str) -> truth.AnnotatedMesh:
        self.folder(scene)
        return truth.read_annotated_mesh(self._original(scene), self.where(scene))

    def _instead(self, scene: str) -> str:
        """A clause on what can score the scene without its mesh; empty if nothing can."""
        try:
            checks.object_boxes_of(self._info(scene), self.where(scene))
        except DataError:
            return ""
        return "; the protocol replica-boxes scores it by the boxes of its objects"

    def _original(self, scene: str) -> Path:
        """The scene's folder in the original release, with both files of the ground truth."""
        original, where = folders.find_original_scene(self.root, scene), self.where(scene)
        if original is None:
            raise GroundTruthMissing(
                f"{where}: no ground truth; expected {folders.original_name(scene)}/{truth.MESH_NAME} of the original "
                f"release in {self.root / 'replica_v1'}: {folders.FETCH_MESHES}"
            )
        for name in (truth.MESH_NAME, truth.INFO_NAME):
            if not (original / name).exists():
                reason = f"{original / name} is missing{self._instead(scene)}"
                raise GroundTruthMissing(f"{where}: no ground truth; {reason}")
        return original
