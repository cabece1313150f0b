"""The layouts in which a scanned dataset can be written as files, by the names of ``--layout``."""

from __future__ import annotations

from collections.abc import Mapping

from su3d_bench.datasets.arkitscenes.writing import ArkitScenesLayout
from su3d_bench.datasets.hm3dsem.writing import HovSgWalkLayout
from su3d_bench.datasets.replica.writing import ReplicaLayout
from su3d_bench.datasets.scannet.writing.exports import CppExportLayout, PythonExportLayout
from su3d_bench.datasets.scannet.writing.layout import SensLayout
from su3d_bench.datasets.scannetpp.writing.layout import ScannetppLayout
from su3d_bench.datasets.tum.writing import TumLayout
from su3d_bench.datasets.writing import Layout

_ALL: tuple[Layout, ...] = (
    ReplicaLayout(),
    SensLayout(),
    PythonExportLayout(),
    CppExportLayout(),
    ScannetppLayout(),
    ArkitScenesLayout(),
    HovSgWalkLayout(),
    TumLayout(),
)
LAYOUTS: Mapping[str, Layout] = {layout.name: layout for layout in _ALL}
