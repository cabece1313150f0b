"""``su3d-bench report bundle``: finished runs as one archive that anybody can score anew."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from su3d_bench.cli.shared.answers import answer_either, remark
from su3d_bench.cli.shared.flags import add_verb
from su3d_bench.core.errors import EXIT_DONE, ConfigError, counted

NAME = "bundle"


def add_parser(actions: Any) -> None:
    parser = add_verb(
        actions,
        NAME,
        "Pack finished runs into one archive that report verify scores anew and a registry takes in.",
        (
            "su3d-bench report bundle runs/my-run --out my-run.zip",
            "su3d-bench report bundle runs/mine --trained-on 'ScanNet v2, training scenes' --out mine.zip",
        ),
        call,
    )
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="folders of finished runs")
    parser.add_argument("--out", type=Path, metavar="FILE", help="the archive (default: the first run's name.zip)")
    parser.add_argument("--trained-on", metavar="TEXT", default="", help="the data of your weights, for a registry")


def call(arguments: argparse.Namespace) -> int:
    from su3d_bench.core.digests import digest_file
    from su3d_bench.reproducing.bundle import bundle_runs, is_bundle
    from su3d_bench.reproducing.verifying import refuse_own_code, refuse_own_truth
    from su3d_bench.runs.finished import read_run

    for path in arguments.runs:
        run = read_run(path)
        refuse_own_code(run)
        refuse_own_truth(run)
    place = arguments.out or Path(f"{arguments.runs[0].resolve().name}.zip")
    if not is_bundle(place):
        raise ConfigError(f"--out {place}: a bundle is called FILE.zip")
    bundle_runs(place, arguments.runs, arguments.trained_on)
    n_bytes = place.stat().st_size
    value = {"file": str(place), "bytes": n_bytes, "sha256": digest_file(place), "runs": len(arguments.runs)}
    line = f"{place}: {counted(len(arguments.runs), 'run')}, {n_bytes / 1e6:.1f} MB, SHA-256 {value['sha256']}"
    answer_either(arguments, value, line)
    remark(f"next: su3d-bench report verify {place}", quiet=arguments.quiet)
    return EXIT_DONE
