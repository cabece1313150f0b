"""The readable formats of predictions, and detection of a path's format."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from su3d_bench.core.errors import ConfigError, PredictionError, StoreError, printable, shown, suggest
from su3d_bench.formats.torch_files import SparseTensor
from su3d_bench.predictions import dense, hovsg, masks, objects
from su3d_bench.predictions import scannet_text as text
from su3d_bench.predictions.base import Content, Reader, file_format, folder_format
from su3d_bench.predictions.run_predictions import OWN_RUNS, of_method
from su3d_bench.predictions.scannet_text import text_format
from su3d_bench.store.records import RunRecord, read_record

# How the files of each format are recognized and read, and their origin.
_ALL = (
    OWN_RUNS,  # prediction.npz of this program, or a run folder
    # ScanNet's submission: <scene>.txt with lines 'mask file, class id, confidence' (also Mask3D, Segment3D)
    text_format("scannet-text", text.looks_like_list, text.scannet_masks),
    # ScanNet's semantic submission: <scene>.txt with one class id per line, one line per point
    text_format("scannet-semantic-text", text.looks_like_labels, text.scannet_labels),
    # ScanNet++'s instance submission: <scene>.txt with lines 'mask.json, class, confidence', run-length masks
    text_format("scannetpp", text.looks_like_scannetpp, text.scannetpp_masks),
    # ScanNet++'s semantic submission: <scene>.txt with one class per line, or three separated by commas
    text_format("scannetpp-semantic", text.looks_like_ranked, text.ranked_labels),
    # The OpenSUN3D challenge's submission: <scene>.txt with lines 'mask file, confidence', without classes
    text_format("opensun3d-challenge", text.looks_like_opensun3d, text.opensun3d_masks),
    # OpenMask3D's <scene>_masks.pt (points, masks) with <scene>_openmask3d_features.npy, or <scene>.pt and .npy
    file_format("openmask3d", ("_masks.pt", ".pt"), masks.looks_like_matrix, masks.openmask3d),
    # MaskClustering's <scene>.npz with pred_masks (points, masks), pred_score and pred_classes (Mask3D's too)
    file_format("maskclustering", (".npz",), masks.looks_like_masks, masks.maskclustering),
    # Open3DIS's <scene>.pth: a dict of ins (run-length masks or a tensor), conf and final_class
    file_format("open3dis", (".pth",), masks.holds(dict, "a dict"), masks.open3dis),
    # Open-YOLO 3D's <scene>.pt: proposals, masks (points, masks) and scores, or masks, classes and scores
    file_format("openyolo3d", (".pt",), masks.holds(tuple, "a tuple"), masks.openyolo3d),
    # OpenIns3D's masks <scene>.pt: a sparse tensor (points, masks), without scores and classes
    file_format("openins3d", (".pt",), masks.holds(SparseTensor, "a sparse tensor"), masks.openins3d),
    # SAM3D's <scene>.pth or .npy: a group number for each point, -1 for none, without scores and classes
    file_format("sam3d", (".npy", ".pth"), masks.looks_like_groups, masks.sam3d),
    # SAM3D's coloured clouds <scene>.ply: one colour per group, black for none, over the points of the scene
    file_format("sam3d-colours", (".ply",), masks.looks_like_colours, masks.sam3d_colours),
    # ConceptGraphs' pcd_saves/full_pcd_*.pkl.gz (_post preferred) or exps/*/pcd_*.pkl.gz of ali-dev
    Reader(
        "conceptgraphs", objects.looks_like_conceptgraphs, objects.conceptgraphs_scenes, objects.conceptgraphs, "map"
    ),
    # ConceptFusion's saved-map/pointclouds of gradslam
    folder_format(
        "gradslam", dense.POINTS, dense.EMBEDDINGS, dense.gradslam, scene_of=dense.scene_of_gradslam, n_above=3
    ),
    # HOV-SG's objects/pcd_<i>.ply (or .pcd) with row i of mask_feats.pt
    folder_format("hovsg", hovsg.FEATURES, hovsg.OBJECTS, hovsg.hovsg),
    # HOV-SG's graph/ with floors, rooms and objects, a .ply and a .json each; the only one with floors and rooms
    folder_format("hovsg-graph", hovsg.FLOORS, hovsg.ROOMS, hovsg.hovsg_graph, "graph", hovsg.scene_of_graph),
    # OpenLex3D's point_cloud.pcd (or .ply, or input.ply) with two tables
    folder_format(
        "openlex3d", dense.LEX_INDEX, dense.LEX_EMBEDDINGS, dense.openlex3d, "prediction", dense.scene_of_openlex3d
    ),
    folder_format("ovo", dense.OVO_MAP, dense.OVO_MAP, dense.ovo),
    # RayFronts' <scene>/map.pt of its evaluation, or a saved map <scene>.pt
    Reader("rayfronts", dense.looks_like_rayfronts, dense.rayfronts_scenes, dense.rayfronts, "map"),
    # ESAM's two tables of its stream demo: one colour per mask, grey for none
    folder_format("esam", masks.COLOURS, masks.POINTS, masks.esam, "prediction"),
    # OnlineAnySeg's masks (points, masks) and their features, with the points
    folder_format("onlineanyseg", masks.ONLINE_MASKS, masks.ONLINE_CLOUD, masks.onlineanyseg, "prediction"),
    # FROSS's scene graphs of all scenes in one file, with the classes and predicates of ReplicaSSG
    Reader("fross", objects.looks_like_fross, objects.fross_scenes, objects.fross, "scene graph"),
)
IN_MEMORY = "arrays in memory"  # instead of a format and a path
READERS: dict[str, Reader] = {reader.name: reader for reader in _ALL}


def recognise(path: Path, format: str | None = None) -> Reader:
    """The reader for ``path``: the one that ``format`` names, otherwise the only one that recognizes the path.

    Raises ``ConfigError`` for an unknown format, ``PredictionError`` if no format or more than one fits.
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
        file, line = text.first_line(path) or (path, "")
        why = f"; {shown(file)}:1: '{printable(line, 80)}' is neither {text.LIST_FORM} nor a class id" if line else ""
        raise PredictionError(f"{path}: is in no known format ({', '.join(READERS)}){why}; name it with --input-format")
    reasons = "; ".join(f"{name}: {why}" for name, why in fitting.items())
    raise PredictionError(f"{path}: could be in {len(fitting)} formats ({reasons}); name one with --input-format")


@dataclass(frozen=True)
class Source:
    """One path of predictions, its reader, and the scene names in its files."""

    path: Path
    reader: Reader
    scenes: tuple[str, ...]


@dataclass(frozen=True)
class Match:
    """The prediction of one scene: ``name`` is its name in ``source``, ``scene`` that in the ground truth."""

    scene: str
    name: str
    source: Source


def memory_sources(contents: Mapping[str, Content]) -> list[Source]:
    """The one source of maps in memory, by scene."""
    places = dict.fromkeys(contents, Path(IN_MEMORY))
    reader = Reader(IN_MEMORY, lambda _: None, lambda _: places, lambda _, scene: (contents[scene], ()))
    return [Source(Path(IN_MEMORY), reader, tuple(contents))]


def open_sources(paths: Sequence[Path], format: str | None, method: str | None = None) -> list[Source]:
    """Every path with the reader that recognizes it; ``method``: the one to read of a run with several."""
    if not paths:
        raise ConfigError("evaluate: no predictions given; name a folder or files")
    sources = []
    for path in paths:
        reader = of_method(recognise(path, format), method)
        scenes = tuple(reader.scenes(path))
        if not scenes:
            raise PredictionError(f"{shown(path)}: has no prediction in the format {reader.name}")
        sources.append(Source(path, reader, scenes))
    return sources


def match_scenes(
    sources: Sequence[Source], known: Sequence[str], dataset: str | None, where: str, requested: Sequence[str] = ()
) -> tuple[list[Match], list[str]]:
    """The prediction of each scene of ``known`` that has one, in that order, and remarks.

    Names match if they are equal ignoring case, ``_`` and ``-``; otherwise the only name that starts with the scene's
    is used, with a remark. A single prediction is that of the single ``requested`` scene, whatever its name. Raises
    ``PredictionError`` if several fit or one fits no scene.
    """
    names = {name: source for source in sources for name in source.scenes}
    if len(names) < sum(len(source.scenes) for source in sources):
        twice = next(n for k, s in enumerate(sources) for n in s.scenes if any(n in t.scenes for t in sources[:k]))
        raise PredictionError(f"scene '{printable(twice, 80)}' is predicted in several paths; give each scene once")
    foreign = [name for name in names if dataset is not None and "/" in name and name.partition("/")[0] != dataset]
    remarks = [f"skipped, of another dataset: {printable(', '.join(foreign), 200)}"] if foreign else []
    own = {name: _plain(name.rpartition("/")[2]) for name in names if name not in foreign}
    if len(requested) == 1 and len(own) == 1 and not is_known(next(iter(own)), known):
        name = next(iter(own))
        remark = f"{requested[0]}: the prediction '{printable(name, 80)}' is used for it, as the only one"
        return [Match(requested[0], name, names[name])], [*remarks, remark]
    taken: dict[str, list[str]] = {}
    for name, plain in own.items():
        taken.setdefault(_scene_of(name, plain, known, where), []).append(name)
    matches = []
    for scene in dict.fromkeys((*known, *taken)):
        if scene in taken:
            name, more = _only_name(scene, taken[scene], own)
            remarks += more
            matches.append(Match(scene, name, names[name]))
    return matches, remarks


def _scene_of(name: str, plain: str, known: Sequence[str], where: str) -> str:
    """The scene that ``name`` refers to: of the same name, otherwise the longest that it begins with."""
    same = [scene for scene in known if _plain(scene) == plain]
    if same:
        return same[0]
    if "/" in name:  # a scene that is generated on demand is not listed
        return name.rpartition("/")[2]
    longer = [scene for scene in known if _is_continued(name, scene)]
    if longer:
        return max(longer, key=len)
    hint = suggest(name, known)
    raise PredictionError(f"{where}: no ground truth for the predicted scene '{printable(name, 80)}'{hint}")


def is_known(name: str, known: Sequence[str]) -> bool:
    """Whether a prediction's name fits one of the scenes; one with a dataset before it always fits."""
    return "/" in name or any(_plain(scene) == _plain(name) or _is_continued(name, scene) for scene in known)


def _is_continued(name: str, scene: str) -> bool:
    """Whether ``name`` is ``scene`` with a suffix: ``room0_mesh``, not ``room01``."""
    forms = (scene, scene.replace("_", ""), scene.replace("-", "_"))
    return any(name.startswith(form) and not name[len(form) : len(form) + 1].isalnum() for form in forms)


def _only_name(scene: str, names: Sequence[str], plain: Mapping[str, str]) -> tuple[str, list[str]]:
    same = [name for name in names if plain[name] == _plain(scene)]
    fitting = same or names
    if len(fitting) > 1:
        listed = printable(", ".join(fitting), 200)
        raise PredictionError(f"{scene}: {len(fitting)} predictions match it ({listed}); give only one")
    chosen, others = fitting[0], printable(", ".join(name for name in names if name not in same), 200)
    if same:
        return chosen, [f"{scene}: '{chosen}' is used; other matches: {others}"] if others else []
    return chosen, [f"{scene}: the prediction '{printable(chosen, 80)}' is used for it"]


def _plain(name: str) -> str:
    return name.lower().replace("_", "").replace("-", "")


def planned_scenes(sources: Sequence[Source], dataset: str) -> list[str] | None:
    """The scenes of ``dataset`` that the run folders of this program cover; None for external predictions."""
    planned: list[str] = []
    for source in sources:
        record_file = source.path / "run.json"
        if source.reader.name != OWN_RUNS.name or not record_file.is_file():
            return None
        try:
            record = read_record(RunRecord, record_file, str(source.path))
        except StoreError:
            return None
        planned += [scene.removeprefix(f"{dataset}/") for scene in record.scenes if scene.startswith(f"{dataset}/")]
    return planned
