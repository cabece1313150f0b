"""``su3d-bench datasets``: what is here, whether it is whole, how it looks, and making what is not."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from su3d_bench.cli import fetch
from su3d_bench.cli.new import add_new
from su3d_bench.cli.options import Verbs, add_group, add_options, add_out, add_verb, count
from su3d_bench.cli.output import answer_either
from su3d_bench.core.errors import EXIT_DONE

LAYOUTS = (
    "native",
    "replica",
    "scannet",
    "scannet-python",
    "scannet-cpp",
    "scannetpp",
    "arkitscenes",
    "hm3dsem",
    "tum",
)
MAX_LISTED = 40


def add_parser(verbs: Verbs) -> None:
    actions = add_group(
        verbs,
        "datasets",
        "List the datasets and their scenes, check, show or fetch scenes, make rooms on disk, or write a dataset.",
        (
            "su3d-bench datasets list",
            "su3d-bench datasets make rooms --scenes rooms/living0 --layout replica --out data",
        ),
        lists=True,
    )
    parser = add_verb(
        actions,
        "list",
        "List every dataset and the scenes that are there; of those named also how to get what is not.",
        ("su3d-bench datasets list", "su3d-bench datasets list scannet --json"),
        call_list,
    )
    parser.add_argument("names", nargs="*", metavar="DATASET", help="such as scannet (default: all)")
    _add_check(actions)
    _add_show(actions)
    _add_make(actions)
    fetch.add_data(actions)
    add_new(actions, "dataset")


def _later(module: str, name: str) -> Callable[[argparse.Namespace], int]:
    """The function ``name`` of a module that takes long to load."""

    def call(arguments: argparse.Namespace) -> int:
        code: int = getattr(import_module(f"su3d_bench.cli.{module}"), name)(arguments)
        return code

    return call


def _add_check(verbs: Verbs) -> None:
    parser = add_verb(
        verbs,
        "check",
        "Look at every file and frame of scenes, name all that is wrong, and tell the digest that results carry.",
        (
            "su3d-bench datasets check 'replica/*'",
            "su3d-bench datasets check rooms/living0 --set rooms.n_frames=40 --json",
        ),
        _later("scenes", "check"),
    )
    parser.add_argument("scenes", nargs="+", metavar="SCENE", help="addresses or patterns, such as 'replica/*'")
    parser.add_argument(
        "--quick",
        action="store_true",
        help="read 20 evenly spaced frames of each scene, as is always done where scenes are made on demand",
    )
    add_options(parser, "--jobs")
    add_options(parser, "--set")


def _add_show(verbs: Verbs) -> None:
    parser = add_verb(
        verbs,
        "show",
        "Draw a scene: the walk seen from above, some frames, and the ground truth by class and by instance.",
        (
            "su3d-bench datasets show rooms/living0 --set rooms.n_frames=40",
            "su3d-bench datasets show replica/room0 --out room0.png --stride 50",
        ),
        _later("scenes", "show"),
    )
    parser.add_argument("scene", metavar="SCENE", help="the scene's address, such as rooms/living0")
    add_out(parser, "FILE", "the PNG to write (default: DATASET-SCENE.png here)")
    parser.add_argument("--stride", type=count, metavar="N", help="draw every Nth camera (default: 48 cameras in all)")
    add_options(parser, "--set")


def _add_make(verbs: Verbs) -> None:
    parser = add_verb(
        verbs,
        "make",
        "Make scenes on disk, whole or not at all; the same command again takes up what a killed one left.",
        (
            "su3d-bench datasets make rooms --layout replica --out data --scenes 'rooms/*'",
            "su3d-bench datasets make rooms --layout scannet --out small --scenes living0 --set n_frames=200",
        ),
        _later("make_scenes", "make"),
        takes_up=True,
    )
    parser.add_argument("dataset", help="what to make scenes of: rooms")
    parser.add_argument("--scenes", nargs="+", metavar="SCENE", help="names or patterns (default: 'DATASET/*')")
    parser.add_argument(
        "--layout",
        choices=LAYOUTS,
        default="native",
        help="native: the scans that the dataset keeps in its data root, frames are rendered when asked for; "
        "replica: every file of Replica, the render and the original release, about 300 MB a room; scannet: scans with "
        ".sens, mesh and annotation (default: native)",
    )
    add_out(parser, "DIR", "the data root to make (native: default $SU3D_DATA)")
    add_options(parser, "--set", "--jobs")


def call_list(arguments: argparse.Namespace) -> int:
    from su3d_bench.runs.catalogue import known_datasets

    root = data_root()
    named = list(dict.fromkeys(arguments.names))
    rows = known_datasets(named, root)
    absent = [] if named else [row for row in rows if row["is_missing"]]
    lines = [f"data root: {root}", *(line for row in rows if row not in absent for line in _lines(row))]
    lines += _absent_lines(absent, root)
    answer_either(arguments, {"data_root": str(root), "datasets": rows}, *lines)
    return EXIT_DONE


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
