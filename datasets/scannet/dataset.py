"""ScanNet: recordings as ``.sens`` files or as either reader exports them, truth from the annotated meshes."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict

from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import DataError, GroundTruthMissing, suggest
from su3d_bench.core.types import Float64Array, Frame, GroundTruth, ImageDomain, InstanceMesh, SceneInfo, Surface
from su3d_bench.datasets import openscan
from su3d_bench.datasets.recordings.recorded_frames import reading
from su3d_bench.datasets.recordings.registration import Grid, make_registration
from su3d_bench.datasets.recordings.source import RgbdSource
from su3d_bench.datasets.scannet.annotations import segments_name
from su3d_bench.datasets.scannet.checks import annotation_problems, recording_problems
from su3d_bench.datasets.scannet.folders import (
    OVO_SCENES,
    PAPER_SCENES,
    SPLITS,
    ScanFolders,
    find_scans,
    no_scans,
    split_scenes,
)
from su3d_bench.datasets.scannet.frames import ScannetFrames, Walk, read_walk
from su3d_bench.datasets.scannet.labels import TABLE_NAME, LabelTable, nyu40_label_set, read_label_table
from su3d_bench.datasets.scannet.recordings import (
    SourceKind,
    describe_recording,
    digest_recording,
    find_source,
    folder_of_recording,
)
from su3d_bench.datasets.scannet.truth import (
    AnnotatedScan,
    aligned,
    instance_mesh,
    mesh_name,
    meta_name,
    moved,
    nyu40_truth,
    read_annotated_scan,
    read_axis_alignment,
    read_surface,
    scannet200_truth,
    truth_names,
)

READER_VERSION = 3  # raise it whenever the same files come out as other frames or another truth
logger = logging.getLogger(__name__)


class ScannetOptions(BaseModel):
    """``source``: which form of a recording is read where there are several. ``grid``: the camera whose images frames
    have (``Registration``). ``axis_align``: turn poses and mesh along the walls, as ``axisAlignment`` says."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    source: SourceKind = "auto"
    grid: Grid = "depth"
    axis_align: bool = False


class ScanNet:
    """ScanNet, recordings and annotated meshes as released or exported; read below the data root."""

    name = "scannet"
    reads_made_rooms = True
    scene_names = r"scene\d{4}_\d\d"
    label_space = "scannet"
    variants: tuple[str, ...] = ("nyu40-vertices", "scannet200-vertices")
    further_truths = openscan.FURTHER_TRUTHS
    Options = ScannetOptions

    def __init__(self, root: Path, options: ScannetOptions | None = None) -> None:
        self.root = root
        self.options = options or ScannetOptions()
        self._scan: tuple[str, AnnotatedScan] | None = None
        self._recording: tuple[str, RgbdSource, Walk] | None = None
        self._warned_of: set[str] = set()

    @cached_property
    def tree(self) -> ScanFolders:
        """Where the scans are; a ``DataError`` that says how to get data where there are none."""
        tree = find_scans(self.root)
        if not tree.folders:
            raise no_scans(self.root)
        return tree

    def scenes(self) -> Sequence[str]:
        """The paper's scenes that are here, in its order, then every other scan."""
        return self.tree.scenes

    def groups(self) -> Mapping[str, Sequence[str]]:
        """The official splits, and the five scenes of the paper and of OVO, by name; whether they are here or not."""
        return {split: split_scenes(split) for split in SPLITS} | {"paper": PAPER_SCENES, "ovo": OVO_SCENES}

    def places(self) -> Sequence[Path]:
        """Where scans are, or else would be looked for first."""
        return find_scans(self.root).places or [self.root / name for name in (".", "scans", "scannet/scans")]

    def status(self, scene: str) -> str:
        """A word on the scene from a quick look: frames, those without a pose among them, and ground truth."""
        frames = describe_recording(self._folder(scene), scene, self._where(scene), self.options.source)
        try:
            self._truth_files(scene)
        except GroundTruthMissing as error:
            return f"{frames}, {str(error).partition(': ')[2]}"
        table = "" if self.tree.find_label_table() else f", no ScanNet200: {TABLE_NAME} is missing"
        return f"{frames}, ground truth{table}"

    def info(self, scene: str, stride: int) -> SceneInfo:
        """Cheap facts: the recording's index is read; frames without a pose are not counted."""
        _, walk = self._open(scene)
        domain: ImageDomain = "rendered-rooms" if scene in self.tree.made else "camera"
        return SceneInfo(self.name, scene, len(walk.every(stride)), stride, domain)

    def frames(self, scene: str, stride: int) -> Sequence[Frame]:
        """The usable ones among the first of every ``stride`` frames; a line of the log counts the others once."""
        source, walk = self._open(scene)
        registration = make_registration(source.camera, self.options.grid, self._where(scene))
        if (line := walk.say_what_is_lost(self._where(scene))) and scene not in self._warned_of:
            self._warned_of.add(scene)
            logger.warning("%s", line)
        return ScannetFrames(source, registration, walk, walk.every(stride), self._motion(scene))

    def files(self, scene: str) -> Sequence[Path]:
        source, _ = self._open(scene)
        return (*source.files(), *self._small_files(scene))

    def digest(self, scene: str) -> str:
        """A key of the content of the truth, the label table, the cameras, all poses and the first and last images,
        and of the sizes of all images: an image in the middle that was changed and kept its size goes unseen."""
        words = "scannet", READER_VERSION, scene, scene in self.tree.made, self.options.model_dump_json()
        total = hashlib.sha256(" ".join(str(word) for word in words).encode())
        source, walk = self._open(scene)
        total.update(digest_recording(source, walk.poses).encode())
        with reading(self._where(scene)):
            for path in self._small_files(scene):
                total.update(f"{path.name} {digest_file(path)}\n".encode())
        return total.hexdigest()

    def ground_truth(self, scene: str, variant: str) -> GroundTruth:
        if variant in self.further_truths:
            return self._attribute_truth(scene, variant)
        if variant not in self.variants:
            hint = suggest(variant, self.variants)
            raise GroundTruthMissing(f"{self._where(scene)}: no ground truth '{variant}'{hint}")
        scan = self._annotated_scan(scene)
        if variant == "nyu40-vertices":
            return nyu40_truth(scan, self._label_tables)
        table = next((table for table in self._label_tables if table.name == TABLE_NAME), None)
        if table is None:
            raise GroundTruthMissing(
                f"{self._where(scene)}: no ground truth '{variant}'; {TABLE_NAME} of the release is missing, put it "
                f"into {self.tree.table_folders()[0]}"
            )
        return scannet200_truth(scan, table)

    def _attribute_truth(self, scene: str, variant: str) -> GroundTruth:
        """OpenScan's attributes of the annotated objects; void where an object has none."""
        where, path = self._where(scene), self._openscan
        if path is None:
            raise GroundTruthMissing(
                f"{where}: no ground truth '{variant}'; {openscan.RAW_NAME} is missing, get it by {openscan.PAGE} and "
                f"put it into {self.tree.table_folders()[0]}"
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
        return self.tree.find_label_table(openscan.RAW_NAME)

    def instance_mesh(self, scene: str) -> InstanceMesh:
        return instance_mesh(self._annotated_scan(scene), self._label_tables)

    def surface(self, scene: str) -> Surface:
        """The decimated mesh, with the published segments where they are here; scans without truth have both."""
        self._folder(scene)
        mesh = self.tree.find_file(scene, mesh_name(scene))
        if mesh is None:
            raise DataError(
                f"{self._where(scene)}: no mesh; {mesh_name(scene)} is missing, copy it into "
                f"{self.tree.folders[scene][0]}"
            )
        surface = read_surface(mesh, self.tree.find_file(scene, segments_name(scene)), scene, self._where(scene))
        motion = self._motion(scene)
        return surface if motion is None else replace(surface, vertices=moved(surface.vertices, motion))

    def problems(self, scene: str) -> Iterator[str]:
        """Every fault of the scene's files, one line each; the readers stop at the first."""
        where, folder = self._where(scene), self._folder(scene)
        yield from recording_problems(
            lambda: find_source(folder, scene, where, self.options.source), self.options.grid, where
        )
        yield from annotation_problems({path.name: path for path in self._small_files(scene)}, scene, where)

    def _where(self, scene: str) -> str:
        return f"{self.name}/{scene}"

    def _folder(self, scene: str) -> Path:
        """The folder of the scan with its recording."""
        if scene not in self.tree.folders:
            known = self.tree.scenes
            hint = suggest(scene, known, f"{self.tree.places[0]} has")
            raise DataError(f"scannet: no scene '{scene}'{hint}")
        return folder_of_recording(self.tree.folders[scene], scene, self.options.source)

    def _open(self, scene: str) -> tuple[RgbdSource, Walk]:
        """The recording of ``scene`` and its poses; the last one is kept, because each step asks for it anew."""
        if self._recording is None or self._recording[0] != scene:
            source = find_source(self._folder(scene), scene, self._where(scene), self.options.source)
            self._recording = scene, source, read_walk(source)
        return self._recording[1:]

    def _motion(self, scene: str) -> Float64Array | None:
        """What is applied to the world; None for nothing."""
        return self._alignment(scene) if self.options.axis_align else None

    def axis_alignment(self, scene: str) -> Float64Array:
        """The motion (4, 4) that turns the truth along the walls; the identity where ``axis_align`` did it already."""
        return np.eye(4) if self.options.axis_align else self._alignment(scene)

    def _alignment(self, scene: str) -> Float64Array:
        path = self.tree.find_file(scene, meta_name(scene))
        if path is None:
            raise DataError(
                f"{self._where(scene)}: {meta_name(scene)} is missing; what lies along the walls needs it, copy it "
                f"into {self.tree.folders[scene][0]}"
            )
        return read_axis_alignment(path, self._where(scene))

    def nyu40_class(self, category: str) -> str | None:
        """The class of NYU40 that the table of the release gives a raw category; None where it has none."""
        table = next((table for table in self._label_tables if table.name == TABLE_NAME), None)
        if table is None:
            raise DataError(
                f"{self.name}: {TABLE_NAME} of the release is missing, by which names of objects have classes; put it "
                f"into {self.tree.table_folders()[0]}"
            )
        class_id = table.nyu40_of.get(category)
        return None if class_id is None else nyu40_label_set().name_of(class_id)

    @cached_property
    def _label_tables(self) -> Sequence[LabelTable]:
        return [read_label_table(path, self.name) for path in self.tree.label_tables()]

    def _small_files(self, scene: str) -> tuple[Path, ...]:
        """What is read of the scene beside its recording, as far as it is there."""
        paths = [self.tree.find_file(scene, name) for name in (meta_name(scene), *truth_names(scene))]
        return tuple(path for path in (*paths, *self.tree.label_tables(), self._openscan) if path is not None)

    def _truth_files(self, scene: str) -> dict[str, Path]:
        """The path of each file of the truth."""
        self._folder(scene)
        path_of = {name: self.tree.find_file(scene, name) for name in truth_names(scene)}
        missing = [name for name, path in path_of.items() if path is None]
        if missing:
            reason = f"; expected in {self.tree.folders[scene][0]}"
            if scene in split_scenes("test"):
                reason = "; the benchmark keeps that of its test scans to itself"
            raise GroundTruthMissing(f"{self._where(scene)}: no ground truth, {missing[0]} is missing{reason}")
        return {name: path for name, path in path_of.items() if path is not None}

    def _annotated_scan(self, scene: str) -> AnnotatedScan:
        """The annotated mesh of ``scene``; the last one is kept, because every protocol asks for it anew."""
        if self._scan is None or self._scan[0] != scene:
            scan = read_annotated_scan(self._truth_files(scene), scene, self._where(scene))
            motion = self._motion(scene)
            self._scan = scene, scan if motion is None else aligned(scan, motion)
        return self._scan[1]
