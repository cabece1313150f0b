"""The formats of predictions that can be read, and which of them a path is in."""

from __future__ import annotations

from pathlib import Path

from su3d_bench.core.errors import ConfigError, PredictionError, suggest
from su3d_bench.formats.torch_files import SparseTensor
from su3d_bench.predictions import dense, hovsg, masks
from su3d_bench.predictions.base import FileFormat, FolderFormat, Reader
from su3d_bench.predictions.objects import ConceptGraphs, Fross
from su3d_bench.predictions.own_runs import OwnRuns
from su3d_bench.predictions.scannet_text import (
    OpenSun3dText,
    ScannetppLabels,
    ScannetppMasks,
    ScannetSemanticText,
    ScannetText,
)

# Files of each format, how they are known and read, and whose they are.
_ALL: tuple[Reader, ...] = (
    OwnRuns(),
    ScannetText(),
    ScannetSemanticText(),
    ScannetppMasks(),
    ScannetppLabels(),
    OpenSun3dText(),
    FileFormat(
        "openmask3d", ("_masks.pt", ".pt"), masks.looks_like_matrix, masks.openmask3d,
        "OpenMask3D's <scene>_masks.pt (points, masks) with <scene>_openmask3d_features.npy, or <scene>.pt and .npy",
    ),
    FileFormat(
        "maskclustering", (".npz",), masks.looks_like_masks, masks.maskclustering,
        "MaskClustering's <scene>.npz with pred_masks (points, masks), pred_score and pred_classes (Mask3D's too)",
    ),
    FileFormat(
        "open3dis", (".pth",), masks.holds(dict, "a dict"), masks.open3dis,
        "Open3DIS's <scene>.pth: a dict of ins (run-length masks or a tensor), conf and final_class",
    ),
    FileFormat(
        "openyolo3d", (".pt",), masks.holds(tuple, "a tuple"), masks.openyolo3d,
        "Open-YOLO 3D's <scene>.pt: proposals, masks (points, masks) and scores, or masks, classes and scores",
    ),
    FileFormat(
        "openins3d", (".pt",), masks.holds(SparseTensor, "a sparse tensor"), masks.openins3d,
        "OpenIns3D's masks <scene>.pt: a sparse tensor (points, masks), without scores and classes",
    ),
    FileFormat(
        "sam3d", (".npy", ".pth"), masks.looks_like_groups, masks.sam3d,
        "SAM3D's <scene>.pth or .npy: a group number for each point, -1 for none, without scores and classes",
    ),
    FileFormat(
        "sam3d-colours", (".ply",), masks.looks_like_colours, masks.sam3d_colours,
        "SAM3D's coloured clouds <scene>.ply: one colour a group, black for none, the points those of the scene",
    ),
    ConceptGraphs(),
    FolderFormat(
        "gradslam", dense.POINTS, dense.EMBEDDINGS, dense.gradslam,
        "ConceptFusion's saved-map/pointclouds of gradslam: pc_points.h5 with pc_embeddings.h5",
        scene_of=dense.scene_of_gradslam, n_above=3,
    ),
    FolderFormat(
        "hovsg", hovsg.FEATURES, hovsg.OBJECTS, hovsg.hovsg,
        "HOV-SG's objects/pcd_<i>.ply (or .pcd) with mask_feats.pt, row i of object i",
    ),
    FolderFormat(
        "hovsg-graph", hovsg.FLOORS, hovsg.ROOMS, hovsg.hovsg_graph,
        "HOV-SG's graph/ with floors, rooms and objects, a .ply and a .json each; the one with floors and rooms",
        noun="graph", scene_of=hovsg.scene_of_graph,
    ),
    FolderFormat(
        "openlex3d", dense.LEX_INDEX, dense.LEX_EMBEDDINGS, dense.openlex3d,
        "OpenLex3D's point_cloud.pcd (or .ply, or input.ply) with index.npy and embeddings.npy",
        noun="prediction", scene_of=dense.scene_of_openlex3d,
    ),
    FolderFormat(
        "ovo", dense.OVO_MAP, dense.OVO_MAP, dense.ovo,
        f"OVO's <scene>/{dense.OVO_MAP}: points with the object of each, and a feature an object",
    ),
    dense.RayFronts(),
    FolderFormat(
        "esam", masks.COLOURS, masks.POINTS, masks.esam,
        f"ESAM's <scene>/{masks.POINTS} and {masks.COLOURS} of its stream demo: one colour a mask, grey for none",
        noun="prediction",
    ),
    FolderFormat(
        "onlineanyseg", masks.ONLINE_MASKS, masks.ONLINE_CLOUD, masks.onlineanyseg,
        f"OnlineAnySeg's <scene>/{masks.ONLINE_MASKS}, masks (points, masks) and their features, with the points "
        f"{masks.ONLINE_CLOUD}",
        noun="prediction",
    ),
    Fross(),
)  # fmt: skip
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
