"""``su3d-bench sheets pictures``: a figure of a run for print: similarity to texts, labels n and n', or answers."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from su3d_bench.cli.shared.answers import answer_either, remark_unseen
from su3d_bench.cli.shared.flags import add_verb
from su3d_bench.core.errors import EXIT_DONE, ConfigError

NAME = "pictures"
SUBJECTS = ("similarity", "labels", "reasoning")
MOST_ROWS = 40  # of one figure
FIGURES = ("comparison", "schemes", "teaser")  # as questions/files/files.py has them


def add_parser(actions: Any) -> None:
    parser = add_verb(
        actions,
        NAME,
        "Draw a figure of a run for print: similarity to texts, labels n and n', or answers with their objects.",
        (
            "su3d-bench sheets pictures runs/my-run --queries 'plant on shelf' 'place to sit' --out heat.pdf",
            "su3d-bench sheets pictures runs/my-run --figure schemes --scenes replica/room0 --out schemes.pdf",
        ),
        call,
    )
    parser.add_argument("run", type=Path, metavar="RUN", help="the folder of a run")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="a .pdf, .png or .svg file")
    parser.add_argument("--what", choices=SUBJECTS, default="similarity", help="what is drawn (default: similarity)")
    parser.add_argument("--queries", nargs="+", default=[], metavar="TEXT", help="texts, or questions to be answered")
    parser.add_argument(
        "--figure", choices=FIGURES, help="the texts of the paper's figure, or of its page's teaser, before --queries"
    )
    parser.add_argument("--scenes", nargs="+", default=[], metavar="S", help="rows (default: the run's first scene)")
    parser.add_argument("--methods", nargs="+", default=[], metavar="M", help="columns (default: all of the run)")
    parser.add_argument("--photo", action="store_true", help="a first column with the colours that the frames saw")
    parser.add_argument("--view", choices=("corner", "above"), default="corner", help="from where (default: a corner)")
    parser.add_argument("--colours", choices=("paper", "cividis"), default="paper", help="of similarity")
    parser.add_argument("--device", default="cpu", help="of the text's encoder (default: cpu)")


def call(arguments: argparse.Namespace) -> int:
    from su3d_bench.questions.question_files import figure_texts
    from su3d_bench.reports.pictures.canvas import scale_stops
    from su3d_bench.reports.pictures.figures import draw_grid
    from su3d_bench.runs.finished import read_run
    from su3d_bench.sheets.figures import Figures
    from su3d_bench.sheets.sources import RunSource

    of_figure = () if arguments.figure is None else figure_texts(arguments.figure)
    texts = [*of_figure, *(query.strip() for query in arguments.queries)]
    if (arguments.what == "labels") == bool(texts) or not all(texts):
        what = "labels take none" if arguments.what == "labels" else f"{arguments.what} needs at least one, not empty"
        raise ConfigError(f"--queries: {what}")
    run = read_run(arguments.run)
    scenes = arguments.scenes or run.scenes[:1]
    if len(scenes) * max(1, len(texts)) > MOST_ROWS:
        raise ConfigError(
            f"--queries, --scenes: give {len(scenes) * len(texts)} rows; at most {MOST_ROWS} fit a figure"
        )
    source = RunSource(run, arguments.methods, scenes)
    figures = Figures(source, with_photo=arguments.photo, view=arguments.view)
    scale, columns = None, figures.columns
    if arguments.what == "labels":
        columns, rows = figures.labels()
    elif arguments.what == "reasoning":
        rows = figures.reasoning(texts, run.encoder(arguments.device))
    else:
        encoder = run.encoder(arguments.device)
        for text in texts:
            remark_unseen(encoder, text, quiet=arguments.quiet)
        rows = figures.similarity(texts, encoder, arguments.colours)
        scale = scale_stops(arguments.colours)
    draw_grid(arguments.out, columns, rows, scale)
    value = {"picture": str(arguments.out), "columns": columns, "rows": [row.title for row in rows]}
    answer_either(arguments, value, str(arguments.out))
    return EXIT_DONE
