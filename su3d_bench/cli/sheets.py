"""``su3d-bench sheets``: sheets for people to judge a run, what their answers add up to, and figures for print."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from su3d_bench.cli import output, sheets_make
from su3d_bench.cli.options import Verbs, add_group, add_verb
from su3d_bench.cli.output import remark
from su3d_bench.core.errors import ConfigError, DataError, counted

if TYPE_CHECKING:
    from su3d_bench.sheets.scores import Scores

SHOWN_FAULTS = 200  # lines; the number of all is told


def add_parser(verbs: Verbs) -> None:
    """Make sheets for people to judge a run, score their answers, and draw figures.

    su3d-bench sheets make runs/my-run --kind retrieval --out sheets
    su3d-bench sheets score ann.csv bob.xlsx --key key/key.json
    """
    actions = add_group(verbs, "sheets", add_parser)
    sheets_make.add_parser(actions)
    _add_score(actions)
    _add_pictures(actions)


def _add_score(verbs: Verbs) -> None:
    parser = add_verb(verbs, "score", call_score)
    parser.option(
        "files [FILE...]", "answers: .csv or .xlsx, in any mixture (default: none, what the ground truth alone says)"
    )
    parser.option("--key FILE", "key.json of the set, or its folder", required=True)
    parser.option(
        "--sheet FILE", "sheet.json of the set, or its folder (default: looked for around the key and the answers)"
    )
    parser.option("--out DIR", "write scores.json, tables and a list of what to look at again there")
    parser.option(
        "--disputed FILE", "sheets of questions: write those that not everybody calls right there, for --leave-out"
    )
    parser.shared("--format")


def call_score(arguments: argparse.Namespace) -> None:
    """Check the answers of all annotators and add them up: accuracies, tests, agreement, people beside the truth.

    su3d-bench sheets score ann.csv bob.xlsx --key key/key.json --out scores
    su3d-bench sheets score ann.csv bob.csv --key key --disputed disputed.csv
    """
    from dataclasses import asdict

    from su3d_bench.formats.tables.table import Prose
    from su3d_bench.reports.tables.judged import sheet_tables
    from su3d_bench.sheets.answers import check_answers, check_key, read_answers
    from su3d_bench.sheets.items import KEY_FILE, read_key, read_sheet
    from su3d_bench.sheets.scores import disputed_csv, score

    key_file = arguments.key / KEY_FILE if arguments.key.is_dir() else arguments.key
    key = read_key(key_file)
    sheet_file = _sheet_file(arguments, key_file, key.sheet_id)
    sheet = read_sheet(sheet_file)
    check_key(sheet, key)
    if arguments.disputed is not None and (sheet.kind != "questions" or not arguments.files):
        raise ConfigError("--disputed: lists what people say of sheets of kind questions; give their key and answers")
    rows, faults = [], []
    for file in dict.fromkeys(arguments.files):
        try:
            rows += read_answers(file)
        except DataError as error:
            faults.append(str(error))
    checked = check_answers(sheet, rows)
    faults += checked.faults
    if faults:
        _refuse(faults, arguments)
    if arguments.files and not checked.judgements:
        raise DataError(f"{', '.join(map(str, arguments.files))}: no answer is in these files")
    if checked.silent and arguments.files:
        remark(f"no answers from {', '.join(checked.silent)}", quiet=arguments.quiet)
    scores = score(sheet, key, checked.judgements, checked.silent)
    if not scores.cells:
        raise DataError(f"{key_file}: the ground truth answers none of its items; give files of people's answers")
    content = asdict(scores)
    if arguments.out is not None:
        _write(arguments.out, scores, sheet_file.parent)
        remark(f"written: {arguments.out}", quiet=arguments.quiet)
    if arguments.disputed is not None:
        path = output.written(arguments.disputed, disputed_csv(key, scores.second_looks))
        remark(f"written: {path}", quiet=arguments.quiet)
    output.answer_tables(arguments, content, [*sheet_tables(content), Prose((_looks_line(scores),))])


def _sheet_file(arguments: argparse.Namespace, key_file: Path, sheet_id: str) -> Path:
    """``sheet.json`` as given, or that of the key's set in the folders around the key and the answers."""
    from su3d_bench.sheets.items import SHEET_FILE, read_sheet

    if arguments.sheet is not None:
        given: Path = arguments.sheet
        return given / SHEET_FILE if given.is_dir() else given
    own = key_file.resolve().parent
    # sets of several kinds lie deeper: sheets/annotation and sheets-key/annotation
    folders = [key_file.parent, *sorted(own.parent.glob("*/")), *sorted(own.parent.parent.glob(f"*/{own.name}/"))]
    folders += [folder for file in arguments.files for folder in (file.parent, file.resolve().parent.parent)]
    for folder in dict.fromkeys(folders):
        file: Path = folder / SHEET_FILE
        if file.is_file() and read_sheet(file).id == sheet_id:
            return file
    raise DataError(f"{SHEET_FILE} of the set is not around the key or the answers; give it with --sheet")


def _refuse(faults: Sequence[str], arguments: argparse.Namespace) -> None:
    """Tell all faults, then raise."""
    if arguments.json:
        output.answer_json(arguments, {"faults": list(faults)})
    else:
        remark(*faults[:SHOWN_FAULTS])
        if len(faults) > SHOWN_FAULTS:
            remark(f"... and {len(faults) - SHOWN_FAULTS} more")
    n = len(faults)
    raise DataError(f"answers: {counted(n, 'fault')}, listed above; nothing was scored; mend them first")


def _write(folder: Path, scores: Scores, sheet_folder: Path) -> None:
    import os
    from dataclasses import asdict

    from su3d_bench.core.files.atomic import make_folder, write_text
    from su3d_bench.reports.tables.formats import FORMATS
    from su3d_bench.reports.tables.judged import sheet_tables
    from su3d_bench.sheets.items import PICTURES
    from su3d_bench.sheets.scores import second_looks_csv, second_looks_page, write_scores

    make_folder(folder)
    content = asdict(scores)
    write_scores(folder, scores)
    tables = sheet_tables(content)
    for suffix, form in (("md", "markdown"), ("csv", "csv"), ("html", "html")):
        write_text(folder / f"tables.{suffix}", FORMATS[form](tables))
    pictures = Path(os.path.relpath((sheet_folder / PICTURES).resolve(), folder.resolve())).as_posix()
    write_text(folder / "second_looks.csv", second_looks_csv(scores.second_looks))
    write_text(folder / "second_looks.html", second_looks_page(scores.second_looks, pictures, scores.sheet_id))


def _looks_line(scores: Scores) -> str:
    n_disagree = sum(look.reason == "annotators disagree" for look in scores.second_looks)
    n_others = len(scores.second_looks) - n_disagree
    others = "that nobody calls right" if scores.kind == "questions" else "against the ground truth"
    return f"To look at again: {n_disagree} where annotators disagree, {n_others} {others}."


SUBJECTS = ("similarity", "labels", "reasoning")
MOST_ROWS = 40  # of one figure
FIGURES = ("comparison", "schemes", "teaser")  # as questions/files/files.py has them


def _add_pictures(verbs: Verbs) -> None:
    parser = add_verb(verbs, "pictures", call_pictures)
    parser.shared("run")
    parser.option("--out FILE", "a .pdf, .png or .svg file", required=True)
    parser.option("--what", "what is drawn (default: similarity)", choices=SUBJECTS, default="similarity")
    parser.option("--queries TEXT...", "texts, or questions to be answered", default=[])
    parser.option(
        "--figure", "the texts of the paper's figure, or of its page's teaser, before --queries", choices=FIGURES
    )
    parser.shared("--scenes", "--methods")
    parser.option("--photo", "a first column with the colours that the frames saw")
    parser.option("--view", "from where (default: a corner)", choices=("corner", "above"), default="corner")
    parser.option("--colours", "of similarity", choices=("paper", "cividis"), default="paper")
    parser.shared("--device")


def call_pictures(arguments: argparse.Namespace) -> None:
    """Draw a figure of a run for print: similarity to texts, labels n and n', or answers with their objects.

    su3d-bench sheets pictures runs/my-run --queries 'plant on shelf' 'place to sit' --out heat.pdf
    su3d-bench sheets pictures runs/my-run --figure schemes --scenes replica/room0 --out schemes.pdf
    """
    from su3d_bench.questions.question_files import figure_texts
    from su3d_bench.reports.pictures.canvas import scale_stops
    from su3d_bench.reports.pictures.figures import draw_grid
    from su3d_bench.runs.finished import read_run
    from su3d_bench.sheets.drawing import Figures
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
        rows = figures.reasoning(texts, run.encoder(arguments.device or "cpu"))
    else:
        encoder = run.encoder(arguments.device or "cpu")
        for text in texts:
            output.remark_unseen(encoder, text, quiet=arguments.quiet)
        rows = figures.similarity(texts, encoder, arguments.colours)
        scale = scale_stops(arguments.colours)
    draw_grid(arguments.out, columns, rows, scale)
    value = {"picture": str(arguments.out), "columns": columns, "rows": [row.title for row in rows]}
    output.answer_either(arguments, value, str(arguments.out))
