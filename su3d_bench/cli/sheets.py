"""``su3d-bench sheets``: annotation sheets for human evaluation, their scores, and figures."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from su3d_bench.cli import output, sheets_make
from su3d_bench.cli.options import Verbs, add_group, add_verb, output_path
from su3d_bench.cli.output import remark
from su3d_bench.core.errors import ConfigError, DataError, counted, printable

if TYPE_CHECKING:
    from su3d_bench.human_eval.scores import Scores
    from su3d_bench.human_eval.sources import RunSource

SHOWN_FAULTS = 200  # lines; the total is printed


def add_parser(verbs: Verbs) -> None:
    """Human evaluation: create annotation sheets, score answers, and draw figures.

    su3d-bench sheets make runs/my-run --kinds retrieval --out sheets
    su3d-bench sheets score ann.csv bob.csv --key sheets-key
    """
    actions = add_group(verbs, "sheets", add_parser)
    sheets_make.add_parser(actions)
    _add_score(actions)
    _add_pictures(actions)


def _add_score(verbs: Verbs) -> None:
    parser = add_verb(verbs, "score", call_score)
    parser.option("files [FILE...]", "annotators' answers, .csv (default: answers from the ground truth)")
    parser.option("--key DIR", "folder of the key: which method made what (or its key.json)", required=True)
    parser.option("--sheet FILE", "sheet.json, or its folder (default: found near the key and answers)")
    parser.option("--out DIR", "folder for scores.json, tables and items to review", type=output_path)
    parser.option("--partial", "score unfinished answers too, without the unanswered questions")
    parser.shared("--format")


def call_score(arguments: argparse.Namespace) -> None:
    """Score the answers of all annotators: accuracy, tests, agreement, comparison with the ground truth.

    su3d-bench sheets score ann.csv bob.csv --key sheets-key --out scores
    su3d-bench sheets score --key sheets-key
    """
    from dataclasses import asdict

    from su3d_bench.formats.tables.table import Prose
    from su3d_bench.human_eval.answers import check_answers, check_key, read_answers
    from su3d_bench.human_eval.items import KEY_FILE, read_key, read_sheet
    from su3d_bench.human_eval.scores import score
    from su3d_bench.reports.tables.judged import sheet_tables

    key_file = arguments.key / KEY_FILE if arguments.key.is_dir() else arguments.key
    key = read_key(key_file)
    sheet_file = _sheet_file(arguments, key_file, key.sheet_id)
    sheet = read_sheet(sheet_file)
    check_key(sheet, key)
    rows, faults = [], []
    for file in dict.fromkeys(arguments.files):
        try:
            rows += read_answers(file)
        except DataError as error:
            faults.append(str(error))
    checked = check_answers(sheet, rows, is_partial=arguments.partial)
    faults += checked.faults
    if faults:
        _refuse(faults, arguments)
    if arguments.files and not checked.judgements:
        raise DataError(f"{', '.join(map(str, arguments.files))}: no answers in these files")
    if checked.silent and arguments.files:
        remark(f"no answers from {', '.join(checked.silent)}", quiet=arguments.quiet)
    scores = score(sheet, key, checked.judgements, checked.silent, checked.comments)
    if not scores.cells:
        raise DataError(f"{key_file}: the ground truth answers no item; give files of answers")
    content = asdict(scores)
    if arguments.out is not None:
        places = (arguments.out.resolve() / f"{name}.csv" for name in ("tables", "review_items"))
        if taken := {file.resolve() for file in arguments.files}.intersection(places):
            raise ConfigError(f"--out {arguments.out}: {taken.pop()} would be replaced; choose another folder")
        _write(arguments.out, scores, sheet_file.parent)
        remark(f"written: {arguments.out}", quiet=arguments.quiet)
    output.answer_tables(arguments, content, [*sheet_tables(content), Prose((_looks_line(scores),))])


def _sheet_file(arguments: argparse.Namespace, key_file: Path, sheet_id: str) -> Path:
    """``sheet.json`` as given, or searched near the key and the answers."""
    from su3d_bench.human_eval.items import SHEET_FILE, read_sheet

    if arguments.sheet is not None:
        given: Path = arguments.sheet
        return given / SHEET_FILE if given.is_dir() else given
    own = key_file.resolve().parent
    # several kinds: sheets/annotation and sheets-key/annotation
    folders = [key_file.parent, *sorted(own.parent.glob("*/")), *sorted(own.parent.parent.glob(f"*/{own.name}/"))]
    folders += [folder for file in arguments.files for folder in (file.parent, file.resolve().parent.parent)]
    for folder in dict.fromkeys(folders):
        file: Path = folder / SHEET_FILE
        if file.is_file() and read_sheet(file).id == sheet_id:
            return file
    raise DataError(f"{SHEET_FILE} not found near the key or the answers; name it with --sheet")


def _refuse(faults: Sequence[str], arguments: argparse.Namespace) -> None:
    """Print all faults, then raise."""
    if arguments.json:
        output.answer_json(arguments, {"faults": list(faults)})
    else:
        remark(*faults[:SHOWN_FAULTS])
        if len(faults) > SHOWN_FAULTS:
            remark(f"... and {len(faults) - SHOWN_FAULTS} more")
    n = len(faults)
    raise DataError(f"answers: {counted(n, 'fault')}, listed above; nothing was scored; fix them first")


def _write(folder: Path, scores: Scores, sheet_folder: Path) -> None:
    import os
    from dataclasses import asdict

    from su3d_bench.core.files.atomic import make_folder, write_text
    from su3d_bench.human_eval.items import PICTURES
    from su3d_bench.human_eval.scores import review_items_csv, review_items_page, write_scores
    from su3d_bench.reports.tables.formats import FORMATS
    from su3d_bench.reports.tables.judged import sheet_tables

    make_folder(folder)
    content = asdict(scores)
    write_scores(folder, scores)
    tables = sheet_tables(content)
    for suffix, form in (("md", "markdown"), ("csv", "csv"), ("html", "html")):
        write_text(folder / f"tables.{suffix}", FORMATS[form](tables))
    pictures = Path(os.path.relpath((sheet_folder / PICTURES).resolve(), folder.resolve())).as_posix()
    write_text(folder / "review_items.csv", review_items_csv(scores.review_items))
    write_text(folder / "review_items.html", review_items_page(scores.review_items, pictures, scores.sheet_id))


def _looks_line(scores: Scores) -> str:
    n_of = Counter(look.reason for look in scores.review_items)
    more = f", {n_of['comment']} with only a comment" if n_of["comment"] else ""
    n, n_against = n_of["annotators disagree"], n_of["against the truth"]
    return f"To review: {n} where annotators disagree, {n_against} against the ground truth{more}."


SUBJECTS = ("similarity", "labels", "reasoning")
MAX_ROWS = 40  # of one figure
FIGURES = ("comparison", "schemes", "teaser")  # as in questions/question_files.py


def _add_pictures(verbs: Verbs) -> None:
    parser = add_verb(verbs, "pictures", call_pictures, data=True)
    parser.shared("run")
    parser.option("--out FIGURE", ".pdf, .png or .svg file to write", required=True)
    parser.shared("--width")
    parser.option("--draw", "what to draw (default: similarity)", choices=SUBJECTS, default="similarity")
    parser.option("--texts TEXT...", "texts to compare with maps (or questions to answer)", default=[])
    parser.option("--paper-figure", "use the texts of a figure of the paper or of its project page", choices=FIGURES)
    parser.shared("--scenes", "--methods")
    parser.option("--photo", "add a column with the colours of the scene")
    parser.option("--view", "viewpoint (default: corner)", choices=("corner", "above"), default="corner")
    parser.option("--colours", "colour map (default: paper)", choices=("paper", "cividis"), default="paper")
    parser.shared("--device")


def _with_maps_to_draw(source: RunSource, arguments: argparse.Namespace) -> RunSource:
    """``source`` without the methods whose maps have nothing to draw, unless that is all; a remark names them."""
    by_feature = arguments.draw == "similarity"

    def has_all(scene: str, method: str) -> bool:
        return source.has_instances(scene, method) and (not by_feature or source.has_features(scene, method))

    left_out = [method for method in source.methods if not all(has_all(scene, method) for scene in source.scenes)]
    drawn = [method for method in source.methods if method not in left_out] or source.methods
    if len(drawn) < len(source.methods):
        names = ", ".join(printable(method, 80) for method in left_out)
        needed = "instances with features" if by_feature else "instances"
        remark(f"without {names}: maps without {needed} cannot be drawn", quiet=arguments.quiet)
    return source.of_methods(drawn)


def call_pictures(arguments: argparse.Namespace) -> None:
    """Draw a figure of a run: similarity to texts, original and refined labels, or answers.

    su3d-bench sheets pictures runs/my-run --texts 'plant on shelf' 'place to sit' --out heat.pdf
    su3d-bench sheets pictures runs/my-run --paper-figure schemes --scenes replica/room0 --out schemes.pdf
    """
    from su3d_bench.human_eval.drawing import Figures
    from su3d_bench.human_eval.sources import RunSource
    from su3d_bench.questions.question_files import figure_texts
    from su3d_bench.reports.pictures.canvas import scale_stops
    from su3d_bench.reports.pictures.figures import draw_grid
    from su3d_bench.runs.finished import read_run

    of_figure = () if arguments.paper_figure is None else figure_texts(arguments.paper_figure)
    texts = [*of_figure, *(query.strip() for query in arguments.texts)]
    if (arguments.draw == "labels") == bool(texts) or not all(texts):
        what = "labels take none" if arguments.draw == "labels" else f"{arguments.draw} needs at least one, not empty"
        raise ConfigError(f"--texts: {what}")
    run = read_run(arguments.run)
    scenes = arguments.scenes or run.scenes[:1]
    if len(scenes) * max(1, len(texts)) > MAX_ROWS:
        raise ConfigError(f"--texts, --scenes: give {len(scenes) * len(texts)} rows; at most {MAX_ROWS} fit a figure")
    source = RunSource(run, arguments.methods, scenes)
    if not arguments.methods:
        source = _with_maps_to_draw(source, arguments)
    figures = Figures(source, with_photo=arguments.photo, view=arguments.view)
    scale, columns = None, figures.columns
    if arguments.draw == "labels":
        columns, rows = figures.labels()
    elif arguments.draw == "reasoning":
        rows = figures.reasoning(texts, run.encoder(arguments.device or "cpu"))
    else:
        encoder = run.encoder(arguments.device or "cpu")
        for text in texts:
            output.remark_unseen(encoder, text, quiet=arguments.quiet)
        rows = figures.similarity(texts, encoder, arguments.colours)
        scale = scale_stops(arguments.colours)
    draw_grid(arguments.out, columns, rows, scale, arguments.width)
    value = {"picture": str(arguments.out), "columns": columns, "rows": [row.title for row in rows]}
    output.answer_either(arguments, value, str(arguments.out))
