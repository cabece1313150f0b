"""``su3d-bench report samples``: a row an instance, predicted or true, to take apart in pandas or a spreadsheet."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import Any

from su3d_bench.cli.shared.answers import answer, answer_document, answer_json, answer_tables, remark
from su3d_bench.cli.shared.bars import progress
from su3d_bench.cli.shared.flags import add_protocols, add_table_format, add_verb
from su3d_bench.core.errors import EXIT_DONE, ConfigError, counted

NAME = "samples"
FORMATS = ("csv", "parquet")


def add_parser(actions: Any) -> None:
    parser = add_verb(
        actions,
        NAME,
        "List every instance of runs, predicted and true: class, confidence, best IoU, kind of error, box.",
        (
            "su3d-bench report samples runs/my-run --out samples.csv",
            "su3d-bench report samples runs/a runs/b --methods opensu3d --format parquet --out samples.parquet",
        ),
        call,
    )
    parser.add_argument("runs", nargs="*", type=Path, metavar="RUN", help="folders of finished runs")
    parser.add_argument("--methods", nargs="+", default=[], metavar="METHOD", help="only these (default: all)")
    add_protocols(parser, "under these alone (default: all of kind instance and semantic)", "PROTOCOL")
    parser.add_argument("--scenes", nargs="+", default=[], metavar="SCENE", help="only these (default: all)")
    parser.add_argument(
        "--format", choices=FORMATS, help="of the rows (default: parquet where --out ends so, else csv)"
    )
    parser.add_argument("--out", type=Path, metavar="FILE", help="write there instead of printing CSV")
    parser.add_argument("--columns", action="store_true", help="say what each column holds, and list nothing")
    add_table_format(parser, "--table-format")


def call(arguments: argparse.Namespace) -> int:
    from su3d_bench.reports.tables.samples import COLUMNS, columns_table

    if arguments.columns:
        if arguments.runs:
            raise ConfigError("report samples: --columns speaks of no run; leave one of them out")
        answer_tables(arguments, [asdict(column) for column in COLUMNS], [columns_table()])
        return EXIT_DONE
    if not arguments.runs:
        raise ConfigError("report samples: name the folder of a run, such as runs/my-run; or --columns")
    return _list(arguments)


def _list(arguments: argparse.Namespace) -> int:
    from su3d_bench.analysis.samples import Chosen, samples
    from su3d_bench.core.files.atomic import make_folder, write_bytes
    from su3d_bench.reports.tables.samples import csv_of, parquet_of
    from su3d_bench.runs.finished import read_run

    is_named = arguments.out is not None and arguments.out.suffix == ".parquet"
    form = arguments.format or ("parquet" if is_named else "csv")
    if form == "parquet":
        if arguments.out is None:
            raise ConfigError("--format parquet: is no text; say where with --out samples.parquet")
        parquet_of(())  # before minutes of work: is it installed?
    chosen = Chosen(tuple(arguments.methods), tuple(arguments.protocols), tuple(arguments.scenes))
    n_scenes = sum(len(chosen.scenes or read_run(run).scenes) for run in arguments.runs)
    with progress(n_scenes, is_quiet=arguments.quiet) as report:
        found = samples(arguments.runs, chosen, report)
    for line in found.remarks:
        remark(line, quiet=arguments.quiet)
    if arguments.out is None:
        if not answer_json(arguments, [asdict(row) for row in found.rows]):
            answer_document(csv_of(found.rows))
        return EXIT_DONE
    make_folder(arguments.out.parent)
    write_bytes(arguments.out, parquet_of(found.rows) if form == "parquet" else csv_of(found.rows).encode())
    if not answer_json(arguments, [asdict(row) for row in found.rows]):
        n_predicted = sum(row.kind == "predicted" for row in found.rows)
        n_true = len(found.rows) - n_predicted
        answer(f"{arguments.out}: {counted(n_predicted, 'predicted instance')}, {n_true} true")
    return EXIT_DONE
