"""The layouts in which a scanned dataset can be written as files, by the names of ``--layout``."""

from __future__ import annotations

from collections.abc import Mapping

from su3d_bench.datasets.replica_layout import ReplicaLayout
from su3d_bench.datasets.scannet_export_layout import CppRecording, PythonRecording
from su3d_bench.datasets.scannet_layout import ScannetLayout, SensRecording
from su3d_bench.datasets.scene_making import Layout
from su3d_bench.datasets.tum_layout import TumLayout

_ALL: tuple[Layout, ...] = (
    ReplicaLayout(),
    ScannetLayout(SensRecording()),
    ScannetLayout(PythonRecording()),
    ScannetLayout(CppRecording()),
    TumLayout(),
)
LAYOUTS: Mapping[str, Layout] = {layout.name: layout for layout in _ALL}
