"""Where walks through HM3DSem lie below the data root, and which there are.

A walk is a folder such as ``hm3dsem_walks/val/00824-Dd4bFSTQ8gi`` with ``rgb/``, ``depth/`` and ``pose/``, as
gen_hm3dsem_walks_from_poses.py of hovsg/HOV-SG (commit 71a8069) writes them, and ``scene_info.json`` with ``objects/``,
as its create_hm3dsem_walks_gt.py does. The annotation of the scene itself, ``<name>.semantic.txt``, lies in the release
of HM3D: ``hm3d/val/<scene>/``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from su3d_bench.core.errors import ScenesMissing
from su3d_bench.datasets.recordings.made_rooms import read_marker
from su3d_bench.datasets.recordings.places import folders_in

WALKS_FOLDER, SPLIT = "hm3dsem_walks", "val"
SPLITS = (SPLIT, "train", "minival")
PLACES = tuple(f"{base}{split}" for base in (f"{WALKS_FOLDER}/", "hm3dsem/", "HM3DSem/", "") for split in SPLITS)
RELEASE_PLACES = tuple(f"{base}/{split}" for base in ("hm3d", "HM3D", "hm3dsem", "HM3DSem") for split in SPLITS)
SCENE_NAMES = r"\d{5}-[A-Za-z0-9]{11}"
COLOUR, DEPTH, POSE, INFO_NAME, OBJECTS = "rgb", "depth", "pose", "scene_info.json", "objects"
LABELS_OF = "hm3d"  # as OpenLex3D calls the dataset
WALKS_URL = "https://github.com/hovsg/HOV-SG#habitat-matterport-3d-semantics"
# The scenes that HOV-SG evaluates by its README, and those that its generator has poses for.
EVALUATED = (
    "00824-Dd4bFSTQ8gi", "00829-QaLdnwvtxbs", "00843-DYehNKdT76V", "00861-GLAQ4DNUx5U",
    "00862-LT9Jq6dN3Ea", "00873-bxsVRursffK", "00877-4ok3usBNeis", "00890-6s7QHgap2fW",
)  # fmt: skip
GROUPS: Mapping[str, tuple[str, ...]] = {
    "hovsg": EVALUATED,
    "walks": tuple(sorted((*EVALUATED, "00847-bCPU9suPUw9", "00849-a8BtkwhxdRV"))),
}


@dataclass(frozen=True)
class Walks:
    """``folder_of`` each walk; ``made`` are those that `datasets make` rendered; ``places``: the folders of walks."""

    places: tuple[Path, ...]
    folder_of: Mapping[str, Path]
    made: frozenset[str]


def find_walks(root: Path) -> Walks:
    """Every walk in ``PLACES`` below ``root``; none is no error here."""
    folder_of: dict[str, Path] = {}
    places, made = [], set[str]()
    for place, children in folders_in(root, PLACES):
        walks = [child for child in children if re.fullmatch(SCENE_NAMES, child.name) and _is_walk(child)]
        if walks:
            rooms = read_marker(place)
            places.append(place)
            made |= {walk.name for walk in walks if walk.name in rooms}
        for walk in walks:
            folder_of.setdefault(walk.name, walk)
    return Walks(tuple(places), dict(sorted(folder_of.items())), frozenset(made))


def _is_walk(folder: Path) -> bool:
    return (folder / POSE).is_dir() or (folder / INFO_NAME).is_file()


def annotation_file(root: Path, walk: Path) -> Path | None:
    """The ``.semantic.txt`` of a walk's scene, beside the walk or in the release; None where it is not there."""
    name = f"{walk.name.partition('-')[2]}.semantic.txt"
    folders = [walk, *(root / place / walk.name for place in RELEASE_PLACES)]
    return next((folder / name for folder in folders if (folder / name).is_file()), None)


def no_walks(root: Path) -> ScenesMissing:
    """The error that says where walks come from."""
    return ScenesMissing(
        f"hm3dsem: no scene in {root / PLACES[0]} (a walk is a folder such as {EVALUATED[0]} with pose/, rgb/ and "
        f"depth/); generate them with HOV-SG's tools ({WALKS_URL}) or make rooms in the layout: su3d-bench datasets "
        "make rooms --layout hm3dsem --out DIR"
    )
