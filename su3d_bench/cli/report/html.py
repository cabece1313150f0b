"""``su3d-bench report html``: one page with the numbers and the maps of runs, to look at in a browser."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from su3d_bench.cli.common import add_verb, answer_either, remark, written
from su3d_bench.core.errors import EXIT_DONE, ConfigError, counted, printable

NAME = "html"
MEGABYTE = 10**6


def add_parser(actions: Any) -> None:
    parser = add_verb(
        actions,
        NAME,
        "Make one page that needs no network: numbers, errors, times, comparisons and the maps in 3D.",
        (
            "su3d-bench report html runs/my-run --out page.html",
            'su3d-bench report html runs/a runs/b --queries "a place to sit" "a plant" --no-errors',
        ),
        call,
    )
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="folders of finished runs")
    parser.add_argument(
        "--out", type=Path, metavar="FILE", default=Path("page.html"), help="the page (default: page.html)"
    )
    parser.add_argument("--title", metavar="TEXT", help="of the page (default: the folders of the runs)")
    parser.add_argument(
        "--queries", nargs="+", metavar="TEXT", help="texts to which instances are compared (default: eight)"
    )
    parser.add_argument("--no-maps", action="store_true", help="leave the maps out")
    parser.add_argument("--no-errors", action="store_true", help="leave out what each kind of error costs (quicker)")
    parser.add_argument(
        "--most-megabytes", type=float, default=30.0, metavar="MB", help="maps are thinned for it (default: 30)"
    )


def call(arguments: argparse.Namespace) -> int:
    from su3d_bench.analysis.page_maps import MOST_POINTS, QUERIES, page_scenes, points_of_each
    from su3d_bench.analysis.page_numbers import page_numbers, scored_maps
    from su3d_bench.reports.page.page import page_html

    if not 0 < arguments.most_megabytes <= 1000:
        raise ConfigError(f"--most-megabytes {arguments.most_megabytes:g}: must be above 0 and at most 1000")
    queries = QUERIES if arguments.queries is None else tuple(printable(text, 120) for text in arguments.queries)

    def progress(line: str) -> None:
        remark(line, quiet=arguments.quiet)

    numbers = page_numbers(arguments.runs, with_errors=not arguments.no_errors, progress=progress)
    maps = [] if arguments.no_maps else scored_maps(arguments.runs)
    most_points = points_of_each(len(maps), round(arguments.most_megabytes * MEGABYTE)) if maps else MOST_POINTS
    scenes = list(page_scenes(maps, queries, most_points, progress))
    title = arguments.title or ", ".join(dict.fromkeys(run.resolve().name for run in arguments.runs))
    shown = [page_map for scene in scenes for page_map in scene.maps]
    page = page_html(
        printable(title, 200),
        {**numbers, "maps": [page_map.listed() for page_map in shown]},
        [scene.listed() for scene in scenes],
        [page_map.content for page_map in shown],
    )
    written(arguments.out, page)
    n_bytes = len(page.encode())
    about = {"page": str(arguments.out), "n_bytes": n_bytes, "n_maps": len(shown), "most_points": most_points}
    answer_either(arguments, about, f"{arguments.out}: {n_bytes / MEGABYTE:.1f} MB, {counted(len(shown), 'map')}")
    return EXIT_DONE
