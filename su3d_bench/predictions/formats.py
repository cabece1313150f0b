"""The formats of predictions that can be read, and which of them a path is in."""

from __future__ import annotations

from pathlib import Path

from su3d_bench.core.errors import ConfigError, PredictionError, suggest
from su3d_bench.predictions.base import Reader
from su3d_bench.predictions.conceptgraphs import ConceptGraphs
from su3d_bench.predictions.gradslam import Gradslam
from su3d_bench.predictions.hovsg import HovSg
from su3d_bench.predictions.hovsg_graph import HovSgGraph
from su3d_bench.predictions.mask_archives import MaskClustering, Open3dis, OpenIns3d, OpenYolo3d
from su3d_bench.predictions.online.esam import Esam
from su3d_bench.predictions.online.fross import Fross
from su3d_bench.predictions.online.onlineanyseg import OnlineAnySeg
from su3d_bench.predictions.online.ovo import Ovo
from su3d_bench.predictions.online.rayfronts import RayFronts
from su3d_bench.predictions.openlex3d import OpenLex3d
from su3d_bench.predictions.openmask3d import OpenMask3d
from su3d_bench.predictions.own_runs import OwnRuns
from su3d_bench.predictions.sam3d import Sam3d, Sam3dColours
from su3d_bench.predictions.scannet_text import OpenSun3dText, ScannetSemanticText, ScannetText
from su3d_bench.predictions.scannetpp import ScannetppLabels, ScannetppMasks

_ALL: tuple[Reader, ...] = (
    OwnRuns(),
    ScannetText(),
    ScannetSemanticText(),
    ScannetppMasks(),
    ScannetppLabels(),
    OpenSun3dText(),
    OpenMask3d(),
    MaskClustering(),
    Open3dis(),
    OpenYolo3d(),
    OpenIns3d(),
    Sam3d(),
    Sam3dColours(),
    ConceptGraphs(),
    Gradslam(),
    HovSg(),
    HovSgGraph(),
    OpenLex3d(),
    Ovo(),
    RayFronts(),
    Esam(),
    OnlineAnySeg(),
    Fross(),
)
READERS: dict[str, Reader] = {reader.name: reader for reader in _ALL}


def recognise(path: Path, format: str | None = None) -> Reader:
    """The reader for ``path``: the one that ``format`` names, otherwise the only one that knows the path as its own.

    Raises ``ConfigError`` for an unknown format, ``PredictionError`` where no format or more than one fits.
    """
    if format is not None:
        if format not in READERS:
            raise ConfigError(f"unknown format '{format}'{suggest(format, READERS)}")
        return READERS[format]
    if not path.exists():
        raise PredictionError(f"{path}: no such file or folder; give the folder of the predictions")
    fitting = {name: why for name, reader in READERS.items() if (why := reader.recognise(path)) is not None}
    if len(fitting) == 1:
        return READERS[next(iter(fitting))]
    if not fitting:
        raise PredictionError(f"{path}: in none of the known formats ({', '.join(READERS)}); name it with --format")
    reasons = "; ".join(f"{name}: {why}" for name, why in fitting.items())
    raise PredictionError(f"{path}: could be in {len(fitting)} formats ({reasons}); name one with --format")
