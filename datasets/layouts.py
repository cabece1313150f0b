"""Layouts in which scenes can be written as files, by the names of ``--layout``."""

from __future__ import annotations

from collections.abc import Mapping

from su3d_bench.datasets.replica.writing import ReplicaLayout
from su3d_bench.datasets.scannet.writing import ScannetLayout
from su3d_bench.datasets.writing import Layout

LAYOUTS: Mapping[str, Layout] = {layout.name: layout for layout in (ReplicaLayout(), ScannetLayout())}
