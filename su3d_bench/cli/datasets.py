"""``su3d-bench datasets``: what is here, whether it is whole, how it looks, and making what is not."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from su3d_bench.cli import fetch
from su3d_bench.cli.new import add_new
from su3d_bench.cli.options import Verbs, add_group, add_verb, count
from su3d_bench.cli.output import answer_either

LAYOUTS = ("native", "replica", "scannet")  # as those of su3d_bench.datasets.layouts, which take long to load
MAX_LISTED = 40


def add_parser(verbs: Verbs) -> None:
    """List the datasets and their scenes, check, show or fetch scenes, make rooms on disk, or write a dataset.

    su3d-bench datasets list
    su3d-bench datasets make rooms --scenes rooms/living0 --layout replica --out data
    """
    actions = add_group(verbs, "datasets", add_parser, lists=True)
    parser = add_verb(actions, "list", call_list)
    parser.option("names [DATASET...]", "such as scannet (default: all)")
    parser = add_verb(actions, "check", call_check)
    parser.option("scenes SCENE...", "addresses or patterns, such as 'replica/*'")
    parser.option(
        "--quick", "read 20 evenly spaced frames of each scene, as is always done where scenes are made on demand"
    )
    parser.shared("--jobs", "--set")
    parser = add_verb(actions, "show", call_show)
    parser.option("scene SCENE", "the scene's address, such as rooms/living0")
    parser.option("--out FILE", "the PNG to write (default: DATASET-SCENE.png here)")
    parser.option("--stride N", "draw every Nth camera (default: 48 cameras in all)", type=count)
    parser.shared("--set")
    parser = add_verb(actions, "make", call_make, takes_up=True)
    parser.option("dataset", "what to make scenes of: rooms")
    parser.option("--scenes SCENE...", "names or patterns (default: 'DATASET/*')")
    parser.option(
        "--layout",
        "native: the scans that the dataset keeps in its data root, frames are rendered when asked for; "
        "replica: every file of Replica, the render and the original release, about 300 MB a room; scannet: scans with "
        ".sens, mesh and annotation (default: native)",
        choices=LAYOUTS,
        default="native",
    )
    parser.option("--out DIR", "the data root to make (native: default $SU3D_DATA)")
    parser.shared("--set", "--jobs")
    fetch.add_data(actions)
    add_new(actions, "dataset")


def call_check(arguments: argparse.Namespace) -> int:
    """Look at every file and frame of scenes, name all that is wrong, and tell the digest that results carry.

    su3d-bench datasets check 'replica/*'
    su3d-bench datasets check rooms/living0 --set rooms.n_frames=40 --json
    """
    from su3d_bench.cli import scenes  # here and below: it takes long to load

    return scenes.check(arguments)


def call_show(arguments: argparse.Namespace) -> None:
    """Draw a scene: the walk seen from above, some frames, and the ground truth by class and by instance.

    su3d-bench datasets show rooms/living0 --set rooms.n_frames=40
    su3d-bench datasets show replica/room0 --out room0.png --stride 50
    """
    from su3d_bench.cli import scenes

    scenes.show(arguments)


def call_make(arguments: argparse.Namespace) -> None:
    """Make scenes on disk, whole or not at all; the same command again takes up what a killed one left.

    su3d-bench datasets make rooms --layout replica --out data --scenes 'rooms/*'
    su3d-bench datasets make rooms --layout scannet --out small --scenes living0 --set n_frames=200
    """
    from su3d_bench.cli import make_scenes

    make_scenes.make(arguments)


def call_list(arguments: argparse.Namespace) -> None:
    """List every dataset and the scenes that are there; of those named also how to get what is not.

    su3d-bench datasets list
    su3d-bench datasets list scannet --json
    """
    from su3d_bench.runs.catalogue import known_datasets

    root = data_root()
    named = list(dict.fromkeys(arguments.names))
    rows = known_datasets(named, root)
    absent = [] if named else [row for row in rows if row["is_missing"]]
    lines = [f"data root: {root}", *(line for row in rows if row not in absent for line in _lines(row))]
    lines += _absent_lines(absent, root)
    answer_either(arguments, {"data_root": str(root), "datasets": rows}, *lines)


def data_root() -> Path:
    """Where a run looks for datasets; said here again because what plans a run takes as long to load as the list."""
    return Path(os.environ.get("SU3D_DATA") or "~/.cache/su3d-bench/data").expanduser()


def _absent_lines(rows: Sequence[dict[str, Any]], root: Path) -> list[str]:
    """A line each for datasets of which nothing is here, places below ``root`` as they are called there."""
    if not rows:
        return []
    width = max(len(row["name"]) for row in rows)
    lines = []
    for row in rows:
        places = [Path(place) for place in row["places"]]
        shown = [str(place.relative_to(root) if place.is_relative_to(root) else place) for place in places]
        lines.append(f"  {row['name']:<{width}}  looked for in {', '.join(shown) or '.'}")
    return ["", "not here (su3d-bench datasets list NAME says how to get one):", *lines]


def _lines(row: dict[str, Any]) -> list[str]:
    lines = ["", f"{row['name']}: {row['summary']}"]
    lines += [f"  looked for in: {place}" for place in row["places"]]
    if row["error"]:
        return [*lines, f"  {row['error']}"]
    scenes = row["scenes"][:MAX_LISTED]
    width = max((len(scene["scene"]) for scene in scenes), default=0)
    lines += [f"  {scene['scene']:<{width}}  {scene['status']}" for scene in scenes]
    n_more = len(row["scenes"]) - len(scenes)
    return [*lines, f"  and {n_more} more; --json lists all"] if n_more else lines
