"""``su3d-bench datasets``: what is here, and making what is not."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

from su3d_bench.cli.flags import add_verb, answer, answer_json
from su3d_bench.errors import EXIT_DONE, DataError, Su3dError

LAYOUTS = ("native", "replica")
MAX_LISTED = 40


def add_parser(verbs: Any) -> None:
    parser = verbs.add_parser(
        "datasets",
        help="list the datasets and their scenes, or make rooms on disk",
        description="List the datasets and their scenes, or make rooms on disk.",
        epilog="examples:\n  su3d-bench datasets list\n"
        "  su3d-bench datasets make rooms --scenes rooms/living0 --layout replica --out data",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    actions = parser.add_subparsers(dest="action", metavar="list|make", required=True)
    add_verb(
        actions,
        "list",
        "List every dataset, where it is looked for, and the scenes that are there.",
        ("su3d-bench datasets list", "su3d-bench datasets list --json"),
        call_list,
    )
    _add_make(actions)


def _add_make(actions: Any) -> None:
    parser = add_verb(
        actions,
        "make",
        "Make scenes on disk, whole or not at all; the same command again takes up what a killed one left.",
        (
            "su3d-bench datasets make rooms --layout replica --out data --scenes 'rooms/*'",
            "su3d-bench datasets make rooms --layout replica --out small --scenes living0 --set n_frames=200",
        ),
        call_make,
    )
    parser.add_argument("dataset", help="what to make scenes of: rooms")
    parser.add_argument("--scenes", nargs="+", metavar="SCENE", help="names or patterns (default: 'DATASET/*')")
    parser.add_argument(
        "--layout",
        choices=LAYOUTS,
        default="native",
        help="native: the scans that the dataset keeps in its data root, frames are rendered when asked for; "
        "replica: every file of Replica, the render and the original release, about 300 MB a room (default: native)",
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="the data root to make (native: default $SU3D_DATA)")
    parser.add_argument(
        "--set",
        nargs="+",
        action="extend",
        default=[],
        metavar="KEY=VALUE",
        help="an option of the dataset, such as n_frames=200",
    )
    parser.add_argument("--workers", type=int, metavar="N", help="processes side by side (default: the CPU cores)")


def call_list(arguments: argparse.Namespace) -> int:
    from su3d_bench import registry

    root = data_root()
    rows = [_row(name, registry.load("dataset", name), root) for name in registry.names("dataset")]
    if arguments.json:
        answer_json({"data_root": str(root), "datasets": rows})
    else:
        answer("\n".join([f"data root: {root}", *(line for row in rows for line in _lines(row))]))
    return EXIT_DONE


def data_root() -> Path:
    """Where a run looks for datasets; said here again because what plans a run takes as long to load as the list."""
    return Path(os.environ.get("SU3D_DATA") or "~/.cache/su3d-bench/data").expanduser()


def _row(name: str, dataset_class: Any, root: Path) -> dict[str, Any]:
    """What is known of a dataset; a dataset may say where it looks (``places``) and how a scene is (``status``)."""
    dataset = dataset_class(root, dataset_class.Options())
    row: dict[str, Any] = {
        "name": name,
        "summary": (dataset_class.__doc__ or "").strip().partition("\n")[0].replace("`", ""),
        "places": [str(place) for place in (dataset.places() if hasattr(dataset, "places") else ())],
        "ground_truth": list(dataset_class.variants),
        "scenes": [],
        "error": None,
    }
    try:
        row["scenes"] = [{"scene": f"{name}/{scene}", "status": _status(dataset, scene)} for scene in dataset.scenes()]
    except DataError as error:
        row["error"] = str(error)
    return row


def _status(dataset: Any, scene: str) -> str:
    try:
        if hasattr(dataset, "status"):
            return str(dataset.status(scene))
        return f"{dataset.info(scene, 1).n_frames} frames"
    except Su3dError as error:
        return str(error)


def _lines(row: dict[str, Any]) -> list[str]:
    lines = [f"\n{row['name']}: {row['summary']}"]
    lines += [f"  looked for in: {place}" for place in row["places"]]
    if row["error"]:
        return [*lines, f"  {row['error']}"]
    scenes = row["scenes"][:MAX_LISTED]
    width = max((len(one["scene"]) for one in scenes), default=0)
    lines += [f"  {one['scene']:<{width}}  {one['status']}" for one in scenes]
    n_more = len(row["scenes"]) - len(scenes)
    return [*lines, f"  and {n_more} more; --json lists all"] if n_more else lines


def call_make(arguments: argparse.Namespace) -> int:
    from su3d_bench.executors import limit_threads

    limit_threads()  # before numerical libraries are loaded
    from su3d_bench.cli.datasets_make import make

    return make(arguments)
