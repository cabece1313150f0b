"""``su3d-bench report html``, ``bundle`` and ``verify``: pages and archives of finished runs."""

from __future__ import annotations

import argparse
import shlex
from dataclasses import asdict
from pathlib import Path

from su3d_bench.cli import output
from su3d_bench.cli.options import Verbs, add_verb, output_path
from su3d_bench.cli.output import answer_either, remark
from su3d_bench.core.errors import EXIT_CHECK_FAILED, EXIT_DONE, ConfigError, counted, printable

MEGABYTE = 10**6


def add_pages(verbs: Verbs) -> None:
    parser = add_verb(verbs, "html", call_html, data=True)
    parser.shared("runs")
    parser.option("--out FILE", "page to write (default: page.html)", type=output_path, default=Path("page.html"))
    parser.option("--title TEXT", "title of the page (default: the run folders)")
    parser.option("--texts TEXT...", "texts to compare with maps (default: eight built-in texts)")
    parser.option("--no-maps", "omit the maps")
    parser.option("--no-errors", "omit the error analysis and the gallery (faster)")
    parser.option("--no-gallery", "omit the gallery of errors")
    parser.option(
        "--max-size-mb MB", "maximum page size; maps are thinned to fit (default: 30)", type=float, default=30.0
    )
    parser.shared("--jobs")


def add_archives(verbs: Verbs) -> None:
    parser = add_verb(verbs, "bundle", call_bundle)
    parser.shared("runs")
    parser.option("--out FILE", "archive to write (default: name of the first run)", type=output_path)
    parser.option("--trained-on TEXT", "training data of your weights, for a registry", default="")
    parser.option("--authors TEXT", "authors, for a registry (default: those of a built-in method)", default="")
    parser.option("--link URL", "https address, for a registry (default: that of a built-in method)", default="")
    parser = add_verb(verbs, "verify", call_verify, data=True)
    parser.option("files FILE...", "LaTeX files written by report tables, or bundle.zip")
    parser.option("--root DIR", "folder of the runs (default: current folder, then that of the file)")


def call_html(arguments: argparse.Namespace) -> None:
    """Create a self-contained HTML report: scores, errors, timings, comparisons and 3D maps.

    su3d-bench report html runs/my-run --out page.html
    su3d-bench report html runs/a runs/b --texts "a place to sit" "a plant" --no-errors
    """
    from su3d_bench.analysis.page.contents import QUERIES, PageOptions, page_contents
    from su3d_bench.analysis.page.gallery import summary_of
    from su3d_bench.reports.page.page import page_html
    from su3d_bench.robustness.page import page_sweeps

    if not 0 < arguments.max_size_mb <= 1000:
        raise ConfigError(f"--max-size-mb {arguments.max_size_mb:g}: must be above 0 and at most 1000")
    wishes = PageOptions(
        queries=QUERIES if arguments.texts is None else tuple(printable(text, 120) for text in arguments.texts),
        max_bytes=round(arguments.max_size_mb * MEGABYTE),
        with_maps=not arguments.no_maps,
        with_errors=not arguments.no_errors,
        with_gallery=not (arguments.no_gallery or arguments.no_errors),
        jobs=arguments.jobs or 0,
    )
    with output.overall_progress("page", is_quiet=arguments.quiet) as (begin, report):
        contents = page_contents(arguments.runs, wishes, begin=begin, report=report)
    sweeps = page_sweeps(arguments.runs)
    title = arguments.title or ", ".join(dict.fromkeys(run.resolve().name for run in arguments.runs))
    maps = contents.maps
    page = page_html(
        printable(title, 200),
        {
            **contents.numbers,
            "maps": [one.listed() for one in maps],
            "gallery": summary_of(contents.galleries),
            "robustness": sweeps,
        },
        [scene.listed() for scene in contents.scenes],
        [page_map.content for page_map in maps],
        list(map(asdict, contents.galleries)),
        command=shlex.join(["su3d-bench", *arguments.words]),
    )
    output.written(arguments.out, page)
    n_bytes = len(page.encode())
    value = {"page": str(arguments.out), "n_bytes": n_bytes, "n_maps": len(maps), "max_points": contents.max_points}
    answer_either(arguments, value, f"{arguments.out}: {n_bytes / MEGABYTE:.1f} MB, {counted(len(maps), 'map')}")


def call_bundle(arguments: argparse.Namespace) -> None:
    """Pack finished runs into an archive that can be re-scored and added to a registry.

    su3d-bench report bundle runs/my-run --out my-run.zip
    su3d-bench report bundle runs/mine --trained-on 'ScanNet v2, training scenes' --out mine.zip
    """
    from su3d_bench.analysis.rescoring import check_dataset_ground_truth
    from su3d_bench.core.digests import digest_file
    from su3d_bench.reproducing.bundle import bundle_runs, check_no_custom_code, is_bundle
    from su3d_bench.runs.verify import read_checked

    for path in arguments.runs:
        run = read_checked(path)
        check_no_custom_code(run)
        check_dataset_ground_truth(run)
    place = arguments.out or Path(f"{arguments.runs[0].resolve().name}.zip")
    if not is_bundle(place):
        raise ConfigError(f"--out {place}: expected a file name that ends in .zip")
    stated = {name: getattr(arguments, name) for name in ("trained_on", "authors", "link")}
    bundle_runs(place, arguments.runs, **stated)
    n_bytes = place.stat().st_size
    value = {"file": str(place), "bytes": n_bytes, "sha256": digest_file(place), "runs": len(arguments.runs)}
    line = f"{place}: {counted(len(arguments.runs), 'run')}, {n_bytes / 1e6:.1f} MB, SHA-256 {value['sha256']}"
    answer_either(arguments, value, line)
    remark(f"next: su3d-bench report verify {place}", quiet=arguments.quiet)


def call_verify(arguments: argparse.Namespace) -> int:
    """Recompute LaTeX tables from their runs, or re-score a bundle; exit code 1 if a value differs.

    su3d-bench report verify paper.tex
    su3d-bench report verify reproduced/opensu3d/bundle.zip --json
    """
    bundles = [file for file in arguments.files if file.suffix.lower() == ".zip"]
    if bundles and len(bundles) < len(arguments.files):
        raise ConfigError("report verify: give either bundles or LaTeX files, not both")
    return _verify_bundles(bundles, arguments) if bundles else _verify_papers(arguments)


def _verify_bundles(bundles: list[Path], arguments: argparse.Namespace) -> int:
    from su3d_bench.reproducing.bundle import verify_bundle

    if arguments.root is not None:
        raise ConfigError("--root: not valid for bundles, which contain their runs")
    found = [verify_bundle(bundle) for bundle in bundles]
    lines = []
    for one in found:
        lines += [f"{one.bundle}: {fault}" for fault in one.faults]
        how = "bit-exact" if one.is_to_the_bit else "integers equal, values within 1e-9"
        verdict = f"differs: {counted(len(one.faults), 'fault')}" if one.faults else f"verified ({how})"
        n_files, n_scores = counted(one.n_files, "file"), counted(one.n_scores, "score")
        lines.append(f"{one.bundle}: {n_files}, {n_scores} recomputed, {counted(one.n_cells, 'cell')}; {verdict}")
    answer_either(arguments, {"bundles": [asdict(one) for one in found]}, *lines)
    return EXIT_CHECK_FAILED if any(one.faults for one in found) else EXIT_DONE


def _verify_papers(arguments: argparse.Namespace) -> int:
    from su3d_bench.analysis.tables import check_paper

    checks = [check for file in arguments.files for check in check_paper(file, arguments.root)]
    differing = [check for check in checks if check.fault is not None]
    value = {"n_cells": len(checks), "n_differing": len(differing), "differing": [*map(asdict, differing)]}
    lines = [f"{check.file}:{check.line}: {check.fault}" for check in differing]
    lines.append(f"{counted(len(checks), 'cell')} checked, {len(differing)} differ")
    answer_either(arguments, value, *lines)
    return EXIT_CHECK_FAILED if differing else EXIT_DONE
