"""Size of the page of 20 scenes under 8 methods, and its loading time in a browser.

``python benchmarks page_opening [RUN] [--opens 5] [--json build/measured/page_opening.json]``: the maps, tables and
times of a finished run (default: ``runs/demo``) are reused for all scenes and methods, thinned as in such a page,
so that the page has a realistic size and tables. Chromium opens it as a file, each time with an
empty profile, without a graphics card. Milliseconds from the start of the navigation: first paint; usable: the summary
is shown and every control works; whole: all sections exist; loaded: the last map is parsed; first map: it is drawn,
after scrolling to the view. Exit code 1 if the page has at least 30 MB, or is not loaded and whole within 3 s.
``--page page.html`` opens an existing page, with exit code 1 if it is not usable within a second.
"""

from __future__ import annotations

import argparse
import copy
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from measured import write_measured

from su3d_bench.analysis.page.contents import PageOptions, page_contents, scored_maps
from su3d_bench.reports.page.page import page_html
from su3d_bench.runs.executors import limit_threads
from su3d_bench.runs.finished import read_run

N_SCENES, N_METHODS = 20, 8
MAX_BYTES, MAX_MS = 30_000_000, 3000.0
MAX_USABLE_MS = 1000.0  # of an existing page of one run
METHODS = [f"method{k}" for k in range(N_METHODS)]
SCENES = [f"rooms/room{k}" for k in range(N_SCENES)]
NOTE = (
    "Processor time: used by the page's process until it was whole, independent of other load. "
    "Usable: the summary is shown and every control works. Whole: all sections exist. Loaded: the last map is "
    "parsed. First map: it is drawn, from the moment of scrolling to the view."
)
TIMES = """(() => {
  const page = performance.getEntriesByType('navigation')[0], marks = performance.getEntriesByType('mark');
  const paint = performance.getEntriesByName('first-contentful-paint')[0];
  const mark = (name) => marks.find((one) => one.name === name)?.startTime;
  return { 'first paint': paint?.startTime, usable: mark('su3d-usable'), whole: mark('su3d-whole'),
    loaded: page.loadEventEnd };
})()"""
FIRST_MAP = "document.querySelector('#maps .say').hidden && document.querySelectorAll('#maps .side tbody tr').length"


def simulated_page(run: Path) -> str:
    """The page of a run as if it had ``N_SCENES`` scenes and ``N_METHODS`` methods."""
    n_maps = len(scored_maps([read_run(run)]))
    page = page_contents([run], PageOptions(max_bytes=MAX_BYTES * n_maps // (N_SCENES * N_METHODS)))
    made, numbers = page.scenes, dict(page.numbers)
    numbers["runs"][0] |= {"scenes": SCENES, "methods": METHODS}
    for key in ("results", "confusions", "errors", "timing"):
        numbers[key] = list(_of_all_methods(numbers[key]))
    numbers["comparisons"] = _comparisons(numbers["comparisons"])
    drawn = [(scene, made[k % len(made)]) for k, scene in enumerate(SCENES)]
    contents = [scene.maps[j % len(scene.maps)].content for _, scene in drawn for j in range(N_METHODS)]
    listed = [{"run": 0, "scene": name, "method": method, "reason": None} for name in SCENES for method in METHODS]
    scenes = [{**scene.listed(), "scene": name} for name, scene in drawn]
    return page_html(f"{N_SCENES} scenes x {N_METHODS} methods", {**numbers, "maps": listed}, scenes, contents)


def _of_all_methods(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows of the first method repeated for all methods and scenes."""
    first = rows[0]["method"] if rows else None
    return [_renamed(row, method) for row in rows if row["method"] == first for method in METHODS]


def _renamed(row: Mapping[str, Any], method: str) -> dict[str, Any]:
    made = copy.deepcopy({**row, "method": method})
    if made.get("result"):
        made["n_planned"] = N_SCENES
        made["result"] |= {"scenes": SCENES, "per_scene": _spread(made["result"]["per_scene"])}
    if "series" in made:
        made |= {"scenes": SCENES, "series": _spread(made["series"])}
    return made


def _spread(values: Mapping[str, Any]) -> dict[str, Any]:
    known = list(values.values())
    return {scene: known[k % len(known)] for k, scene in enumerate(SCENES)}


def _comparisons(known: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """All pairs of methods, each with the differences of the first known pair."""
    whole = next((one for one in known if one["protocols"]), None)
    if whole is None:
        return []
    pairs = [(a, b) for k, a in enumerate(METHODS) for b in METHODS[k + 1 :]]
    made = [copy.deepcopy({**whole, "left": [0, a], "right": [0, b]}) for a, b in pairs]
    for one in made:
        for protocol in one["protocols"]:
            protocol["scenes"] = SCENES
            for difference in protocol["metrics"].values():
                difference["per_scene"] = _spread(difference["per_scene"])
    return made


def opened(page: Path) -> dict[str, float]:
    """Milliseconds of one opening."""
    import chromium

    chromium.FLAGS = (*chromium.FLAGS, "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
    with tempfile.TemporaryDirectory() as folder, chromium.Chromium(Path(folder), width=1440, height=900) as browser:
        browser.call("Performance.enable")
        browser.open(page)
        browser.until("!document.querySelector('#main[aria-busy]')")
        found: dict[str, float] = browser.run(TIMES)
        counters = {one["name"]: one["value"] for one in browser.call("Performance.getMetrics")["metrics"]}
        found["processor time"] = 1000 * counters["ProcessTime"]
        start = time.perf_counter()
        browser.run("document.getElementById('maps').scrollIntoView()")
        browser.until(FIRST_MAP)
        return {**found, "first map": 1000 * (time.perf_counter() - start)}


def measured(page: Path, n_opens: int) -> tuple[list[dict[str, float]], list[list[str]]]:
    """The times of each opening, and a table of them, which is printed too."""
    rows = [opened(page) for _ in range(n_opens)]
    table = []
    for name in rows[0]:
        values = np.array([row[name] for row in rows])
        table.append([name, f"{np.median(values):.0f} ms", f"{values.max():.0f} ms"])
        print(f"{name}: median {table[-1][1]}, worst {table[-1][2]}")
    return rows, table


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", nargs="?", type=Path, default=Path("runs/demo"), help="(default: runs/demo)")
    parser.add_argument("--opens", type=int, default=5, help="number of openings (default: 5)")
    parser.add_argument("--out", type=Path, help="keep the page in this file")
    parser.add_argument("--page", type=Path, metavar="FILE", help="open this page instead of creating one")
    parser.add_argument("--json", type=Path, help="write the table to FILE")
    arguments = parser.parse_args()
    limit_threads()
    command, about = "python benchmarks page_opening runs/demo", f"{N_SCENES} scenes under {N_METHODS} methods"
    with tempfile.TemporaryDirectory() as folder:
        page = arguments.page or arguments.out or Path(folder) / "page.html"
        if arguments.page is None:
            page.write_text(simulated_page(arguments.run), encoding="utf-8")
        else:
            command, about = f"python benchmarks page_opening --page {page.name}", page.name
        n_bytes = page.stat().st_size
        print(f"{about}: {n_bytes / 1e6:.1f} MB")
        rows, table = measured(page, arguments.opens)
    if arguments.json is not None:
        title = f"The page of {about}, {n_bytes / 1e6:.1f} MB, opened in Chromium"
        notes = [
            f"{arguments.opens} openings as a file, each with an empty profile, drawn without a graphics card.",
            NOTE,
        ]
        write_measured(arguments.json, title, command, ["from the start", "median", "worst"], table, notes)
    if arguments.page is not None:
        return int(float(np.median([row["usable"] for row in rows])) >= MAX_USABLE_MS)
    worst = max(max(row["loaded"], row["whole"]) for row in rows)
    return int(n_bytes >= MAX_BYTES or worst >= MAX_MS)


if __name__ == "__main__":
    sys.exit(main())
