"""Scenes whose names differ in one character that no folder's name can hold."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

if str(Path(__file__).parent) not in sys.path:
    sys.path.insert(0, str(Path(__file__).parent))

from painted import Collector, Painted

from su3d_bench.core.types import Frame, GroundTruth, InstanceMesh, SceneInfo

PAINTED_AS = {"a/b": "a", "a_b": "b", "a%2Fb": "c"}


class Twins(Painted):
    """Painted scenes under such names, all different."""

    name = "twins"

    def scenes(self) -> Sequence[str]:
        return tuple(PAINTED_AS)

    def digest(self, scene: str) -> str:
        return super().digest(PAINTED_AS[scene])

    def info(self, scene: str, stride: int) -> SceneInfo:
        return replace(super_info(self, scene, stride), dataset=self.name, scene=scene)

    def frames(self, scene: str, stride: int) -> Sequence[Frame]:
        return super().frames(PAINTED_AS[scene], stride)

    def ground_truth(self, scene: str, variant: str) -> GroundTruth:
        return super().ground_truth(PAINTED_AS[scene], variant)

    def instance_mesh(self, scene: str) -> InstanceMesh:
        return super().instance_mesh(PAINTED_AS[scene])


def super_info(dataset: Twins, scene: str, stride: int) -> SceneInfo:
    plain: Any = Painted(Path(), dataset.options)
    info: SceneInfo = plain.info(PAINTED_AS[scene], stride)
    return info


class SlashCollector(Collector):
    """A method whose name is a way to another folder."""

    name = "../elsewhere"
