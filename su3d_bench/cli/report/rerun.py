"""``su3d-bench report rerun``: the scenes of a run along their frames, for rerun's viewer."""

from __future__ import annotations

import argparse
import shlex
from functools import partial
from pathlib import Path
from typing import Any

from su3d_bench.cli.shared.answers import answer_either, remark
from su3d_bench.cli.shared.bars import progress
from su3d_bench.cli.shared.flags import add_verb
from su3d_bench.core.errors import EXIT_DONE, ConfigError, counted, printable

NAME = "rerun"
MEGABYTE = 10**6


def add_parser(actions: Any) -> None:
    parser = add_verb(
        actions,
        NAME,
        "Write frames, masks, maps and truth of a run on one timeline, for rerun's viewer.",
        (
            "su3d-bench report rerun runs/my-run --out my-run.rrd",
            "su3d-bench report rerun runs/my-run --scenes rooms/office0 --methods opensu3d --stride 2 --out office.rrd",
        ),
        call,
    )
    parser.add_argument("run", type=Path, metavar="RUN", help="the folder of a finished run")
    parser.add_argument("--scenes", nargs="+", default=[], metavar="SCENE", help="these alone (default: all)")
    parser.add_argument("--methods", nargs="+", default=[], metavar="METHOD", help="these alone (default: all)")
    parser.add_argument(
        "--stride",
        type=int,
        metavar="N",
        help="every Nth of the frames that the methods were given (default: at most 60 of a scene)",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="the .rrd file, read by rerun's viewer")


def call(arguments: argparse.Namespace) -> int:
    from su3d_bench.analysis.page.maps import Spaces
    from su3d_bench.analysis.timeline import SceneTimeline, refuse_nothing
    from su3d_bench.core.files.atomic import make_folder, replacing
    from su3d_bench.reports.timeline import Recording, rerun_sdk
    from su3d_bench.runs.executors import Event
    from su3d_bench.runs.finished import read_run
    from su3d_bench.sheets.sources import chosen_of
    from su3d_bench.store.run_folder import refuse_records

    if arguments.stride is not None and arguments.stride < 1:
        raise ConfigError(f"--stride {arguments.stride}: expected 1 or more")
    if arguments.out.suffix != ".rrd" or arguments.out.is_dir():
        raise ConfigError(f"--out {printable(str(arguments.out), 200)}: expected a file name that ends in .rrd")
    run = read_run(arguments.run)
    scenes = chosen_of(run, "scene", arguments.scenes, run.scenes)
    methods = chosen_of(run, "method", arguments.methods, run.methods)
    sdk = rerun_sdk()
    refuse_records(arguments.out)
    spaces = Spaces(())
    timelines = [SceneTimeline(run, scene, methods, arguments.stride or 0, spaces) for scene in scenes]
    make_folder(arguments.out.parent)
    with progress(len(timelines), is_quiet=arguments.quiet) as report, replacing(arguments.out) as stream:

        def tell(scene: str, done: int, total: int) -> None:
            report(Event(scene, "frames", done, total))

        for one in timelines:
            one.write(Recording(sdk, one.scene, methods, stream), partial(tell, one.scene))
        refuse_nothing(timelines, run.name)
    for one in timelines:
        for line in one.remarks:
            remark(f"{printable(one.scene, 120)}: {line}", quiet=arguments.quiet)
    n_bytes, n_frames = arguments.out.stat().st_size, sum(one.n_frames for one in timelines)
    n_maps = sum(one.n_maps for one in timelines)
    about = {
        "file": str(arguments.out), "n_bytes": n_bytes, "rerun": str(sdk.__version__), "n_frames": n_frames,
        "n_maps": n_maps, "scenes": list(scenes), "methods": list(methods),
    }  # fmt: skip
    shown = f"{counted(len(scenes), 'scene')}, {counted(n_maps, 'map')}, {counted(n_frames, 'frame')}"
    answer_either(
        arguments,
        about,
        f"{arguments.out}: {n_bytes / MEGABYTE:.1f} MB, {shown}",
        f"look at it: rerun {shlex.quote(str(arguments.out))} (version {sdk.__version__}; others may not read it)",
    )
    return EXIT_DONE
