"""``su3d-bench report html``: one page with the numbers and the maps of runs, to look at in a browser."""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from su3d_bench.cli.shared.answers import answer_either, remark, written
from su3d_bench.cli.shared.bars import drawn_bars
from su3d_bench.cli.shared.flags import add_verb
from su3d_bench.core.errors import EXIT_DONE, ConfigError, counted, printable

if TYPE_CHECKING:
    from su3d_bench.analysis.page.contents import Amount
    from su3d_bench.runs.executors import Event

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
        takes_up=True,
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
    parser.add_argument(
        "--no-errors", action="store_true", help="leave out what errors cost, and their gallery (quicker)"
    )
    parser.add_argument("--no-gallery", action="store_true", help="leave out the single errors and their photos")
    parser.add_argument(
        "--most-megabytes", type=float, default=30.0, metavar="MB", help="maps are thinned for it (default: 30)"
    )
    parser.add_argument(
        "--jobs", type=int, default=0, metavar="N", help="scenes made side by side (default: the CPU cores)"
    )


def call(arguments: argparse.Namespace) -> int:
    from su3d_bench.analysis.page.contents import QUERIES, Wishes, page_contents
    from su3d_bench.analysis.page.gallery import told_of
    from su3d_bench.reports.page.page import page_html

    if not 0 < arguments.most_megabytes <= 1000:
        raise ConfigError(f"--most-megabytes {arguments.most_megabytes:g}: must be above 0 and at most 1000")
    if arguments.jobs < 0:
        raise ConfigError(f"--jobs {arguments.jobs}: must be 1 or more; 0 stands for the CPU cores")
    wishes = Wishes(
        queries=QUERIES if arguments.queries is None else tuple(printable(text, 120) for text in arguments.queries),
        most_bytes=round(arguments.most_megabytes * MEGABYTE),
        with_maps=not arguments.no_maps,
        with_errors=not arguments.no_errors,
        with_gallery=not (arguments.no_gallery or arguments.no_errors),
        jobs=arguments.jobs,
    )
    arguments.takes_up = all(os.access(run, os.W_OK) for run in arguments.runs)  # else nothing is kept
    with drawn_bars(is_quiet=arguments.quiet, tells_time_left=True) as bars:
        progress = _Progress(bars, is_quiet=arguments.quiet)
        contents = page_contents(arguments.runs, wishes, begin=progress.begin, report=progress.report)
    title = arguments.title or ", ".join(dict.fromkeys(run.resolve().name for run in arguments.runs))
    maps = contents.maps
    page = page_html(
        printable(title, 200),
        {
            **contents.numbers,
            "maps": [page_map.listed() for page_map in maps],
            "gallery": told_of(contents.galleries),
        },
        [scene.listed() for scene in contents.scenes],
        [page_map.content for page_map in maps],
        [gallery.to_json() for gallery in contents.galleries],
    )
    written(arguments.out, page)
    n_bytes = len(page.encode())
    about = {
        "page": str(arguments.out), "n_bytes": n_bytes, "n_maps": len(maps), "most_points": contents.most_points,
    }  # fmt: skip
    answer_either(arguments, about, f"{arguments.out}: {n_bytes / MEGABYTE:.1f} MB, {counted(len(maps), 'map')}")
    return EXIT_DONE


class _Progress:
    """What of the page is made: a bar with the time that is left, or a line a scene where stderr is no terminal."""

    def __init__(self, bars: Any, *, is_quiet: bool) -> None:
        self._bars = bars
        self._is_quiet = is_quiet
        self._done: dict[str, int] = {}
        self._n_scenes_done = 0

    def begin(self, amount: Amount) -> None:
        self._amount, self._since = amount, time.monotonic()
        if amount.n_kept:
            self._say(f"{counted(amount.n_kept, 'scene')} as made before")
        if self._bars is not None and amount.n_steps:
            self._task = self._bars.add_task("page", total=amount.n_steps, remark="")

    def report(self, event: Event) -> None:
        from su3d_bench.runs.executors import SCENE_DONE

        self._done[event.unit] = event.done
        n_done, is_scene = sum(self._done.values()), event.label == SCENE_DONE
        self._n_scenes_done += is_scene
        doing = "done" if is_scene else event.label
        if self._bars is not None:
            self._bars.update(self._task, completed=n_done, description=f"{printable(event.unit, 60)}: {doing}")
        elif is_scene:
            left_s = (time.monotonic() - self._since) * (self._amount.n_steps / max(1, n_done) - 1)
            left = f", about {left_s:.0f} s left" if n_done < self._amount.n_steps else ""
            self._say(f"{printable(event.unit, 120)}: {self._n_scenes_done} of {self._amount.n_scenes} scenes{left}")

    def _say(self, text: str) -> None:
        remark(text, quiet=self._is_quiet)
