"""``su3d-bench datasets``: list, check, show, fetch and generate datasets."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from su3d_bench.cli import fetch
from su3d_bench.cli.new import add_new
from su3d_bench.cli.options import Verbs, add_group, add_verb, count, output_path
from su3d_bench.cli.output import answer_either
from su3d_bench.cli.paths import data_root

LAYOUTS = ("native", "replica", "scannet")  # a copy of su3d_bench.datasets.layouts, which is slow to import
MAX_LISTED = 40


def add_parser(verbs: Verbs) -> None:
    """List, check, show, fetch and generate datasets, or create your own.

    su3d-bench datasets list
    su3d-bench datasets make homes --scenes tuning0 --layout replica --out data
    """
    actions = add_group(verbs, "datasets", add_parser, lists=True)
    parser = add_verb(actions, "list", call_list, data=True)
    parser.option("names [DATASET...]", "datasets to list (default: all)")
    parser = add_verb(actions, "check", call_check, data=True)
    parser.option("scenes SCENE...", "scenes or patterns, such as 'replica/*'")
    parser.option("--quick", "read only 20 evenly spaced frames of each scene")
    parser.shared("--jobs", "--set")
    parser = add_verb(actions, "show", call_show, data=True)
    parser.option("scene SCENE", "scene, such as homes/test0; a pattern with --statistics")
    parser.option("--statistics", "print instances, views and motion instead")
    parser.option("--models [NAME...]", "models or classes of homes to draw instead (default: all)")
    parser.option("--out FIGURE", "picture to write: .pdf, .png or .svg (default: DATASET-SCENE.png)")
    parser.shared("--width")
    parser.option("--stride N", "use every Nth frame (default: 48 frames in total)", type=count)
    parser.shared("--set")
    parser = add_verb(actions, "make", call_make, resumes=True)
    parser.option("dataset", "dataset to generate: homes or rooms")
    parser.option("--scenes SCENE...", "scenes or patterns to use (default: 'DATASET/*')")
    parser.option(
        "--layout",
        "file layout: native (ground truth only), replica or scannet (default: native)",
        choices=LAYOUTS,
        default="native",
    )
    parser.option("--out DIR", "data root (default: $SU3D_DATA if native, else none)", type=output_path)
    parser.shared("--set", "--jobs")
    fetch.add_data(actions)
    add_new(actions, "dataset")


def call_check(arguments: argparse.Namespace) -> int:
    """Check every file and frame of scenes, and report all problems and the dataset digest.

    su3d-bench datasets check 'replica/*'
    su3d-bench datasets check homes/tuning0 --set homes.n_frames=40 --json
    """
    from su3d_bench.cli import scenes  # here and below: slow to import

    return scenes.check(arguments)


def call_show(arguments: argparse.Namespace) -> None:
    """Draw a scene: camera path from above, sample frames, and the ground truth by class and instance.

    su3d-bench datasets show replica/room0 --out room0.png --stride 50
    su3d-bench datasets show homes --models chair lamp
    """
    from su3d_bench.cli import scenes

    scenes.show(arguments)


def call_make(arguments: argparse.Namespace) -> None:
    """Generate scenes on disk; the same command resumes after an interruption.

    su3d-bench datasets make homes --layout replica --out data --scenes 'test*'
    su3d-bench datasets make rooms --layout scannet --out small --scenes bathroom0 --set n_frames=120
    """
    from su3d_bench.cli import make_scenes

    make_scenes.make(arguments)


def call_list(arguments: argparse.Namespace) -> None:
    """List datasets and available scenes; for named datasets, also how to get missing scenes.

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


def _absent_lines(rows: Sequence[dict[str, Any]], root: Path) -> list[str]:
    """One line per dataset that was not found, with places relative to ``root``."""
    if not rows:
        return []
    width = max(len(row["name"]) for row in rows)
    lines = []
    for row in rows:
        places = [Path(place) for place in row["places"]]
        shown = [str(place.relative_to(root) if place.is_relative_to(root) else place) for place in places]
        lines.append(f"  {row['name']:<{width}}  looked for in {', '.join(shown) or '.'}")
    return ["", "not found (su3d-bench datasets list NAME shows how to get one):", *lines]


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
