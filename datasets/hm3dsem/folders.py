"""Where walks through HM3DSem lie below the data root, and which there are.

A walk is a folder such as ``hm3dsem_walks/val/00824-Dd4bFSTQ8gi`` with ``rgb/``, ``depth/`` and ``pose/``, as
gen_hm3dsem_walks_from_poses.py of hovsg/HOV-SG (commit 71a8069) writes them, and ``scene_info.json`` with ``objects/``,
as its create_hm3dsem_walks_gt.py does. The annotation of the scene itself, ``<name>.semantic.txt``, lies in the release
of HM3D: ``hm3d/val/<scene>/``.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

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


def annotation_file(root: Path, walk: Path) -> Path | None:
    """The ``.semantic.txt`` of a walk's scene, beside the walk or in the release; None where it is not there."""
    name = f"{walk.name.partition('-')[2]}.semantic.txt"
    folders = [walk, *(root / place / walk.name for place in RELEASE_PLACES)]
    return next((folder / name for folder in folders if (folder / name).is_file()), None)
