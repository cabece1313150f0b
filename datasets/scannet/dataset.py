"""ScanNet: recordings as ``.sens`` files or as either reader exports them, ground truth from the annotated meshes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict

from su3d_bench.core.errors import DataError, GroundTruthMissing
from su3d_bench.core.types import Float64Array, Frame, GroundTruth, InstanceMesh, Surface
from su3d_bench.datasets import openscan
from su3d_bench.datasets.recordings.file_dataset import FileDataset, SceneTree, faults_of, keeps_last, shortened
from su3d_bench.datasets.recordings.source import Grid, RgbdSource, make_registration
from su3d_bench.datasets.scannet import folders, recordings, truth
from su3d_bench.formats.ply import read_ply


def recording_problems(open_source: Callable[[], RgbdSource], grid: Grid, where: str) -> Iterator[str]:
    """Faults of the recording's index, cameras and poses."""
    try:
        source = open_source()
        walk, is_faulty = recordings.classify_poses(source)
    except DataError as error:
        yield str(error)
        return
    numbers = walk.numbers[np.flatnonzero(is_faulty)]
    yield from shortened((recordings.faulty_pose(where, int(number)) for number in numbers), where)
    reads = [] if len(numbers) else [partial(recordings.read_walk, source)]
    yield from faults_of([*reads, partial(make_registration, source.camera, grid, where)])


def annotation_problems(files: Mapping[str, Path], scan: str, where: str) -> Iterator[str]:
    """Faults of the existing files (by name), each alone and, if the ground truth is complete, together."""
    readers: dict[str, Callable[[Path], object]] = {
        truth.TABLE_NAME: lambda path: truth.read_label_table(path, where),
        truth.FIRST_TABLE_NAME: lambda path: truth.read_label_table(path, where),
        openscan.RAW_NAME: openscan.read_attributes,
        truth.meta_name(scan): lambda path: truth.read_axis_alignment(path, where),
        truth.segments_name(scan): lambda path: truth.read_segments(path, scan, where),
        truth.aggregation_name(scan): lambda path: truth.read_objects(path, scan, where),
        truth.mesh_name(scan): lambda path: read_ply(path, f"{where}: {path.name}"),
        truth.labels_name(scan): lambda path: read_ply(path, f"{where}: {path.name}"),
    }
    reads: list[Callable[[], object]] = [partial(read, files[name]) for name, read in readers.items() if name in files]
    if set(truth.truth_names(scan)) <= set(files):
        reads.append(partial(truth.read_annotated_scan, files, scan, where))
    yield from faults_of(reads)


class ScannetOptions(BaseModel):
    """``source``: which form of a recording is read if there are several. ``grid``: the camera whose images frames
    use (``Registration``). ``axis_align``: align poses and mesh with the walls, by ``axisAlignment``."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    source: recordings.SourceKind = "auto"
    grid: Grid = "depth"
    axis_align: bool = False


class ScanNet(FileDataset[ScannetOptions]):
    """ScanNet, recordings and annotated meshes as released or exported; read below the data root."""

    name = "scannet"
    headline_protocol = "scannet200-instance"  # reported by OpenMask3D and its successors
    reader_version = 4
    reads_made_rooms = True
    scene_names = r"scene\d{4}_\d\d"
    places_of_scenes = (".", "scans", "scannet/scans")
    how_to_get = (
        " or in its folders scans, scannet, scannet/scans (a scan is a folder such as scene0000_00 with "
        "scene0000_00.sens or exported frames); su3d-bench datasets fetch scannet explains how to get it from "
        "http://www.scan-net.org; or set SU3D_DATA to its folder, or create a room in this layout: su3d-bench datasets "
        "make rooms --layout scannet --scenes bathroom0 --set n_frames=120 --out DIR"
    )
    label_space = "scannet"
    variants = ("nyu40-vertices", "scannet200-vertices")
    extra_ground_truths = openscan.EXTRA_GROUND_TRUTHS
    Options = ScannetOptions

    def find_tree(self) -> SceneTree:
        return folders.find_scans(self.root)

    def groups(self) -> Mapping[str, Sequence[str]]:
        """The official splits, and the five scenes of the paper and of OVO, by name; available or not."""
        return {split: folders.split_scenes(split) for split in folders.SPLITS} | {
            "paper": folders.PAPER_SCENES,
            "ovo": folders.OVO_SCENES,
        }

    def status(self, scene: str) -> str:
        """One-line summary of the scene from a quick look: frames (including those without a pose), ground truth."""
        frames = recordings.describe_recording(self.folder(scene), scene, self.where(scene), self.options.source)
        try:
            self._truth_files(scene)
        except GroundTruthMissing as error:
            return f"{frames}, {str(error).partition(': ')[2]}"
        table = "" if folders.find_table(self.tree) else f", no ScanNet200: {truth.TABLE_NAME} is missing"
        return f"{frames}, ground truth{table}"

    def n_frames(self, scene: str, stride: int) -> int:
        """Reads the recording's index; frames without a pose are not counted."""
        return len(self._open(scene)[1].every(stride))

    def frames(self, scene: str, stride: int) -> Sequence[Frame]:
        """The usable ones among every ``stride``-th frame; the number of others is logged once."""
        source, walk = self._open(scene)
        registration = make_registration(source.camera, self.options.grid, self.where(scene))
        self.warn_once(scene, walk.missing_frames_remark(self.where(scene)))
        return recordings.ScannetFrames(source, registration, walk, walk.every(stride), self._motion(scene))

    def recording_files(self, scene: str) -> Sequence[Path]:
        return self._open(scene)[0].files()

    def recording_key(self, scene: str) -> str:
        source, walk = self._open(scene)
        return recordings.digest_recording(source, walk.poses)

    def ground_truth(self, scene: str, variant: str) -> GroundTruth:
        attributes = variant in self.extra_ground_truths
        return self._attribute_truth(scene, variant) if attributes else super().ground_truth(scene, variant)

    def own_truth(self, scene: str, variant: str) -> GroundTruth:
        scan = self._annotated_scan(scene)
        if variant == "nyu40-vertices":
            return truth.nyu40_truth(scan, self._label_tables)
        table = next((table for table in self._label_tables if table.name == truth.TABLE_NAME), None)
        if table is None:
            raise GroundTruthMissing(
                f"{self.where(scene)}: no ground truth '{variant}'; {truth.TABLE_NAME} of the release is missing, put "
                f"it into {folders.table_folders(self.tree)[0]}"
            )
        return truth.scannet200_truth(scan, table)

    def _attribute_truth(self, scene: str, variant: str) -> GroundTruth:
        """OpenScan's attributes of the annotated objects; void for objects without attributes."""
        where, path = self.where(scene), self._openscan
        if path is None:
            raise GroundTruthMissing(
                f"{where}: no ground truth '{variant}'; {openscan.RAW_NAME} is missing, get it by {openscan.PAGE} and "
                f"put it into {folders.table_folders(self.tree)[0]}"
            )
        attributes = self._attributes.get(scene)
        if attributes is None:
            raise GroundTruthMissing(f"{where}: no ground truth '{variant}'; {path.name} has no record of this scan")
        scan = self._annotated_scan(scene)
        id_of = openscan.attribute_ids(attributes, variant, f"{where}: {path.name}")
        of_object = [*(id_of.get(entry.id, 0) for entry in scan.objects), 0]
        semantic = np.array(of_object, np.int32)[scan.object_of_vertex]
        labels = openscan.label_set(variant)
        return GroundTruth(scan.vertices, semantic, scan.instance, labels, variant, f"the attributes in {path.name}")

    @cached_property
    def _attributes(self) -> Mapping[str, openscan.Attributes]:
        return {} if self._openscan is None else openscan.read_attributes(self._openscan)

    @property
    def _openscan(self) -> Path | None:
        return folders.find_table(self.tree, openscan.RAW_NAME)

    def instance_mesh(self, scene: str) -> InstanceMesh:
        return truth.instance_mesh(self._annotated_scan(scene), self._label_tables)

    def surface(self, scene: str) -> Surface:
        """The decimated mesh, with the published segments if available; scans without ground truth have both."""
        self.folder(scene)
        mesh = folders.find_file(self.tree, scene, truth.mesh_name(scene))
        if mesh is None:
            raise DataError(
                f"{self.where(scene)}: no mesh; {truth.mesh_name(scene)} is missing, copy it into "
                f"{self.tree.folders[scene][0]}"
            )
        surface = truth.read_surface(
            mesh, folders.find_file(self.tree, scene, truth.segments_name(scene)), scene, self.where(scene)
        )
        motion = self._motion(scene)
        return surface if motion is None else replace(surface, vertices=truth.moved(surface.vertices, motion))

    def problems(self, scene: str) -> Iterator[str]:
        """Every fault of the scene's files, one line each; readers stop at the first."""
        where, folder = self.where(scene), self.folder(scene)
        yield from recording_problems(
            lambda: recordings.find_source(folder, scene, where, self.options.source), self.options.grid, where
        )
        yield from annotation_problems({path.name: path for path in self.small_files(scene)}, scene, where)

    def folder(self, scene: str) -> Path:
        """The folder of the scan with its recording."""
        super().folder(scene)
        return recordings.folder_of_recording(self.tree.folders[scene], scene, self.options.source)

    @keeps_last
    def _open(self, scene: str) -> tuple[RgbdSource, recordings.RecordedPoses]:
        """The recording of ``scene`` and its poses."""
        source = recordings.find_source(self.folder(scene), scene, self.where(scene), self.options.source)
        return source, recordings.read_walk(source)

    def _motion(self, scene: str) -> Float64Array | None:
        """The transform applied to the world; None for none."""
        return self._alignment(scene) if self.options.axis_align else None

    def axis_alignment(self, scene: str) -> Float64Array:
        """The motion (4, 4) that aligns the ground truth with the walls; the identity if ``axis_align`` already did."""
        return np.eye(4) if self.options.axis_align else self._alignment(scene)

    def _alignment(self, scene: str) -> Float64Array:
        path = folders.find_file(self.tree, scene, truth.meta_name(scene))
        if path is None:
            raise DataError(
                f"{self.where(scene)}: {truth.meta_name(scene)} is missing; it is needed for wall alignment, copy "
                f"it into {self.tree.folders[scene][0]}"
            )
        return truth.read_axis_alignment(path, self.where(scene))

    def nyu40_class(self, category: str) -> str | None:
        """The NYU40 class of a raw category in the release's table; None if it has none."""
        table = next((table for table in self._label_tables if table.name == truth.TABLE_NAME), None)
        if table is None:
            raise DataError(
                f"{self.name}: {truth.TABLE_NAME} of the release is missing, which maps object names to classes; "
                f"put it into {folders.table_folders(self.tree)[0]}"
            )
        class_id = table.nyu40_of.get(category)
        return None if class_id is None else truth.nyu40_label_set().name_of(class_id)

    @cached_property
    def _label_tables(self) -> Sequence[truth.LabelTable]:
        return [truth.read_label_table(path, self.name) for path in folders.label_tables(self.tree)]

    def small_files(self, scene: str) -> tuple[Path, ...]:
        paths = [
            folders.find_file(self.tree, scene, name) for name in (truth.meta_name(scene), *truth.truth_names(scene))
        ]
        return tuple(path for path in (*paths, *folders.label_tables(self.tree), self._openscan) if path is not None)

    def _truth_files(self, scene: str) -> dict[str, Path]:
        """The path of each file of the ground truth."""
        self.folder(scene)
        path_of = {name: folders.find_file(self.tree, scene, name) for name in truth.truth_names(scene)}
        missing = [name for name, path in path_of.items() if path is None]
        if missing:
            reason = f"; expected in {self.tree.folders[scene][0]}"
            if scene in folders.split_scenes("test"):
                reason = "; it is not published for test scans"
            raise GroundTruthMissing(f"{self.where(scene)}: no ground truth, {missing[0]} is missing{reason}")
        return {name: path for name, path in path_of.items() if path is not None}

    @keeps_last
    def _annotated_scan(self, scene: str) -> truth.AnnotatedScan:
        scan, motion = (
            truth.read_annotated_scan(self._truth_files(scene), scene, self.where(scene)),
            self._motion(scene),
        )
        return scan if motion is None else truth.aligned(scan, motion)
