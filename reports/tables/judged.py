"""Tables IV and V of OpenSU3D's paper and its reasoning scores, judged by annotators or by ground truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from su3d_bench.core.errors import ConfigError, counted, printable
from su3d_bench.formats.tables.table import NOT_MEASURED, Cell, Table, TableRow, bracketed, percent, signed, text_table
from su3d_bench.metrics.questions.score import ANSWERED_BY, REFINED_BY, remarks_starting
from su3d_bench.numerics.statistics import ALPHA, holm
from su3d_bench.reports.tables import paper
from su3d_bench.reports.tables.model import ANNOTATED_SUFFIX, Measured

REFINED = "refined label (n')"
PAPER_MODEL = "gpt-4-1106-preview"  # used for labels n' and for reasoning
ROLE_LABELS = {"reasoning": ANSWERED_BY, "annotation": REFINED_BY}  # prefixes of notes in a sheet's key


@dataclass(frozen=True)
class JudgedLayout:
    """``parts``: label of each row of a method -> column -> metric; '' if a method has a single row."""

    kind: str
    subject: str
    columns: tuple[str, ...]
    parts: Mapping[str, Mapping[str, str]]


KINDS = ("instance", "affordance", "property", "relative")
JUDGED: Mapping[paper.PaperTable, JudgedLayout] = {
    "IV": JudgedLayout("retrieval", "Retrieval by text", KINDS, {"": {}}),
    "V": JudgedLayout(
        "annotation",
        "Labels and merging",
        ("label-accuracy", "merge-accuracy"),
        {
            "direct label (n)": {"label-accuracy": "label n", "merge-accuracy": "well-merged"},
            REFINED: {"label-accuracy": "label n'", "merge-accuracy": "well-merged n'"},
        },
    ),
    "reasoning": JudgedLayout(
        "reasoning", "Spatial reasoning", ("reasoning-accuracy", "objects"), {"": {"reasoning-accuracy": "answer"}}
    ),
}


def judged_table(
    number: paper.PaperTable, results: Sequence[Measured], shown: paper.Shown, *, with_published: bool
) -> Table:
    """Return Table IV, V or reasoning with the columns of each dataset: annotators, ground truth, published numbers."""
    layout = JUDGED[number]
    rows = [row for row in results if row.kind == layout.kind]
    if not any(row.per_scene for row in rows):
        have = ", ".join(dict.fromkeys(row.protocol for row in results))
        if rows:
            raise ConfigError(f"Table {number}: no scene has a score under {have}; 'runs show RUN' lists the failures")
        wanted = " or ".join(f"{dataset}-{layout.kind}" for dataset in ("rooms", "replica", "scannet"))
        raise ConfigError(
            f"Table {number}: needs protocol {wanted}, or scores of sheets of kind {layout.kind}; found {have}"
        )
    shown = replace(
        shown, metrics=shown.metrics or layout.columns, only_significant=True, n_judged=True, unit="fraction"
    )
    names = list(dict.fromkeys(row.datasets for row in rows if row.per_scene))
    parts = {
        name: _of_dataset(layout, [row for row in rows if row.datasets == name or not row.per_scene], shown)
        for name in names
    }
    columns = [column if len(names) == 1 else f"{name} {column}" for name in names for column in parts[name].columns]
    reported, sources = _reported(paper.figures_of(is_wanted=with_published, table=number), names, shown, parts)
    # the paper's retrieval, labels and reasoning were judged by humans
    judges = [] if all(row.is_by_people for row in rows) else ["judges"]
    made_by = [who for row in rows for start in ROLE_LABELS.values() for who in remarks_starting(row.warnings, start)]
    models = [] if all(PAPER_MODEL in who for who in made_by) else ["language model"]
    setup = paper.other_setup(rows, is_its_protocol=True, datasets=tuple(paper.PAPER_SCENES), more=(*models, *judges))
    caption = f"{layout.subject} on {', '.join(names)}{setup}."
    rows_of_all, notes = (*_joined(list(parts.values())), *reported), (*_joined_notes(parts), *sources)
    return Table(f"{number}-{'-'.join(names)}", caption, "method, judge", tuple(columns), rows_of_all, notes)


def _joined_notes(parts: Mapping[str, Table]) -> list[str]:
    """Return the notes of all parts, each once, prefixed with their judges and datasets."""
    places: dict[str, list[str]] = {}
    for name, part in parts.items():
        for judged in part.notes:
            judge, _, note = judged.partition(": ")
            places.setdefault(note, []).append(judge if len(parts) == 1 else f"{judge} on {name}")
    return [f"{', '.join(where)}: {note}" for note, where in places.items()]


def _of_dataset(layout: JudgedLayout, measured: Sequence[Measured], shown: paper.Shown) -> Table:
    """Return the part of a table for one dataset."""
    body: list[TableRow] = []
    notes: list[str] = []
    columns: tuple[str, ...] = ()
    for protocol in sorted({row.protocol for row in measured}, key=lambda name: not name.endswith(ANNOTATED_SUFFIX)):
        rows = [row for row in measured if row.protocol == protocol]
        if not any(row.per_scene for row in rows):
            continue
        parts = [_part(row, name, layout) for row in rows for name in layout.parts]
        table = paper.protocol_table(parts, shown, [])
        judge = "annotators" if rows[0].is_by_people else "ground truth"
        scored = [part for part in parts if part.per_scene or part.failed]
        body += [_named(*both, judge, layout) for both in zip(table.rows, scored, strict=True)]
        notes += [f"{judge}: {note}" for note in table.notes]
        columns = max(columns, table.columns, key=len)
    return Table("", "", "", columns, tuple(body), tuple(notes))


def _joined(parts: Sequence[Table]) -> list[TableRow]:
    """Join the rows of several parts by label, with dashes for missing cells; annotators' rows come first."""
    first = {row.label: row for part in parts for row in part.rows}
    wide = []
    for label, row in sorted(first.items(), key=lambda item: item[1].group != "annotators"):
        own = [next((one.cells for one in part.rows if one.label == label), ()) for part in parts]
        wide.append(replace(row, cells=_side_by_side(own, parts)))
    return wide


def _side_by_side(cells: Sequence[Sequence[Cell]], parts: Sequence[Table]) -> tuple[Cell, ...]:
    filled = [
        [*own, *[Cell(NOT_MEASURED)] * (len(part.columns) - len(own))] for own, part in zip(cells, parts, strict=True)
    ]
    return tuple(cell for own in filled for cell in own)


def _reported(
    figures: Sequence[paper.Figure], names: Sequence[str], shown: paper.Shown, parts: Mapping[str, Table]
) -> tuple[list[TableRow], list[str]]:
    """Return the paper's rows with the digits as printed, each dataset under its own columns.

    If none of the datasets is measured, all rows are shown under the measured columns.
    """
    if not any(figure.dataset in names for figure in figures):
        return paper.reported_rows(figures, shown.metrics, len(parts[names[0]].columns), as_fractions=True)
    kept = [figure for figure in figures if figure.dataset in names and set(shown.metrics) & set(figure.values)]
    rows, sources = paper.reported_rows(kept, shown.metrics, len(shown.metrics), as_fractions=True)
    of_label: dict[str, dict[str, TableRow]] = {}
    for figure, row in zip(kept, rows, strict=True):
        of_label.setdefault(row.label, {})[figure.dataset] = row
    joined = []
    for label, by_dataset in of_label.items():
        own = [by_dataset[name].cells if name in by_dataset else () for name in names]
        marks = ", ".join(dict.fromkeys(row.mark for row in by_dataset.values()))
        joined.append(TableRow(label, _side_by_side(own, list(parts.values())), is_reported=True, mark=marks))
    return joined, sources


def _part(row: Measured, part: str, layout: JudgedLayout) -> Measured:
    """Return ``row`` with the metrics of one part under the names of their columns."""
    names = layout.parts[part]
    known = {column: name for column, name in names.items() if name in row.metrics}
    of_labels = row.tests.get(("label", row.method))  # n' against n, over the same instances
    others = [f"{row.method}: {other}" for other in layout.parts if other != part] if of_labels else []
    return replace(
        row,
        method=f"{row.method}: {part}" if part else row.method,
        metrics=dict(row.metrics)
        | {
            f"{lead}{column}": row.metrics.get(f"{lead}{name}") for column, name in known.items() for lead in ("", "n_")
        },
        intervals=dict(row.intervals) | {column: row.intervals.get(name) for column, name in known.items()},
        ceilings=dict(row.ceilings) | {column: row.ceilings.get(name) for column, name in known.items()},
        per_scene={
            scene: dict(values) | {column: values.get(name) for column, name in known.items()}
            for scene, values in row.per_scene.items()
        },
        tests=dict(row.tests) | {("label-accuracy", other): of_labels for other in others if of_labels},
    )


def _named(row: TableRow, part: Measured, judge: str, layout: JudgedLayout) -> TableRow:
    """Return ``row`` labelled with the source of labels or answers and its judge; the origin of each cell names the
    original metric, for ``report verify``."""
    label = row.label.replace(REFINED, f"{REFINED[:-1]} {_refined_by(part)})" if _refined_by(part) else REFINED)
    solvers = remarks_starting(part.warnings, ANSWERED_BY)
    label += f", answers by {' and '.join(solvers)}" if solvers else ""
    return replace(row, label=f"{label}, {judge}", group=judge, cells=tuple(_own(c, layout) for c in row.cells))


def _refined_by(part: Measured) -> str:
    """Return the source of label n': a vote, or a model's name."""
    who = [source.partition(" of ")[0] for source in remarks_starting(part.warnings, REFINED_BY)]
    credits = ("is a vote" if one == "the vote" else f"by {one}" for one in who)
    return " and ".join(dict.fromkeys(printable(one, 100) for one in credits))


def _own(cell: Cell, layout: JudgedLayout) -> Cell:
    if cell.origin is None:
        return cell
    method, _, part = cell.origin.method.rpartition(": ")
    if "" in layout.parts:
        method, part = cell.origin.method, ""
    elif part not in layout.parts:
        return cell
    metric = layout.parts[part].get(cell.origin.metric, cell.origin.metric)
    return replace(cell, origin=replace(cell.origin, method=method, metric=metric))


SUBJECTS = {
    "retrieval": ("Retrieval by text", "is the top-ranked instance correct?"),
    "annotation": ("Labels and merging of instances", "is the label correct, how is the mask merged?"),
    "reasoning": ("Spatial reasoning", "are the answer and its objects correct?"),
}
JUDGES = {"people": "annotators", "automatic": "ground truth"}
GROUND_TRUTH_NOTE = "Ground-truth rows: the same items, judged automatically if the ground truth covers them"
SHOWN_TESTS = 60  # pairs of methods per metric; scores.json has all


def sheet_tables(scores: Mapping[str, Any]) -> list[Table]:
    """Return accuracies per dataset, tests between methods, agreement, and annotators compared with ground truth."""
    datasets = dict.fromkeys(cell["dataset"] for cell in scores["cells"])
    tables = [_accuracies(scores, dataset) for dataset in datasets]
    if any(test["n_differ"] for test in scores["tests"]):
        tables.append(_tests(scores["tests"]))
    elif scores["tests"]:
        same = f"no difference between methods in {counted(len(scores['tests']), 'comparison')}"
        tables[-1] = replace(tables[-1], notes=(*tables[-1].notes, same))
    shared = [question for question in scores["agreements"] if question["agreement"]["n_items"]]
    tables += [_agreements(shared)] if shared else []
    pairs = [(question["ask"], pair) for question in shared for pair in question["agreement"]["pairs"]]
    tables += [_pairs(pairs)] if pairs else []
    return [*tables, *(_confusion(confusion, scores["automatic_rule"]) for confusion in scores["confusions"])]


def _accuracies(scores: Mapping[str, Any], dataset: str) -> Table:
    cells = {(c["judge"], c["method"], c["metric"]): c for c in scores["cells"] if c["dataset"] == dataset}
    metrics = list(dict.fromkeys(metric for _, _, metric in cells))
    rows = []
    for judge, what in JUDGES.items():
        methods = dict.fromkeys(method for who, method, _ in cells if who == judge)
        for method in methods:
            row = tuple(_accuracy(cells.get((judge, method, metric))) for metric in metrics)
            rows.append(TableRow(f"{method} ({what})", row, group=judge))
    n_scenes = len({scene for cell in cells.values() for scene in cell["per_scene"]})
    # methods share items, so that a sum would count judgements several times
    unclear = max((c["n_cannot_tell"] for c in cells.values() if c["judge"] == "people"), default=0)
    subject, question = SUBJECTS[scores["kind"]]
    assigned = {name: scores["assigned"].get(name, n) for name, n in scores["annotators"].items()}
    is_partial = assigned != scores["annotators"]
    people = ", ".join(
        f"{name} {n}" + (f" of {assigned[name]}" if is_partial else "") for name, n in scores["annotators"].items()
    )
    judged = f"{scores['n_judged']} of {scores['n_items']} items judged; judgements by {people}"
    judged += "; unanswered questions are excluded" if is_partial else ""
    judged = judged if people else f"not judged by annotators; {scores['n_items']} items"
    return Table(
        name=f"{scores['kind']}-{dataset}",
        caption=f"{subject} on {dataset}, {counted(n_scenes, 'scene')}: {question}",
        head="method",
        columns=tuple(metrics),
        rows=tuple(rows),
        notes=(
            "Per cent; in brackets Wilson's 95 % confidence interval over items, then the number of items. An item "
            f"judged by several annotators counts once, with the share of them who chose it. {GROUND_TRUTH_NOTE}",
            f"set {scores['sheet_id']} of run {scores['run']}; {judged}",
            *(printable(remark, 300) for remark in scores["remarks"]),
            *([f"{ROLE_LABELS[scores['kind']]}{printable(by, 200)}"] if (by := scores["answered_by"]) else []),
            *([f"'cannot tell' is excluded: at most {counted(unclear, 'judgement')} per number"] if unclear else []),
            *([f"no answers from {', '.join(scores['silent'])}"] if scores["silent"] else []),
        ),
    )


def _accuracy(cell: Mapping[str, Any] | None) -> Cell:
    if cell is None or cell["value"] is None:
        return Cell(NOT_MEASURED)
    return Cell(percent(cell["value"]), f"{bracketed(cell['interval'])} n={cell['n_items']}".lstrip())


def _tests(tests: Sequence[Mapping[str, Any]]) -> Table:
    rows = []
    differing = [test for test in tests if test["n_differ"]]
    corrected = holm([test["p"] for test in differing])
    for test, of_all in zip(differing[:SHOWN_TESTS], corrected, strict=False):
        texts = (test["metric"], str(test["n_items"]), str(test["n_differ"]))
        p = f"{test['p']:.3g}" if test["is_exact"] else f"about {test['p']:.2g}"
        cells = (
            *map(Cell, texts),
            Cell(signed(test["difference"]), bracketed(test["interval"], signed)),
            Cell(p),
            Cell(f"{of_all:.3g}"),
            Cell(f"{test['smallest_p']:.2g}"),
        )
        rows.append(TableRow(f"{test['right']} - {test['left']} ({test['dataset']})", cells))
    n_same, n_more = len(tests) - len(differing), len(differing) - len(rows)
    odd = [f"{row.label}, {t['metric']}" for row, t in zip(rows, differing, strict=False) if _disagree(t)]
    return Table(
        name="differences",
        caption="Differences between methods, judged by annotators.",
        head="difference",
        columns=("metric", "n", "differ", "points", "p", "adjusted p", "smallest p"),
        rows=tuple(rows),
        notes=(
            "p: two-sided sign-flip test over differing items (McNemar's exact test if each is judged once); adjusted "
            "p: Holm's correction over all comparisons with a difference; smallest p: the smallest possible",
            *([f"interval and test disagree (the test decides) for {'; '.join(odd)}"] if odd else []),
            *([f"{n_same} of {len(tests)} comparisons without a difference are omitted"] if n_same else []),
            *([f"{n_more} more differences are in scores.json"] if n_more else []),
        ),
    )


def _disagree(test: Mapping[str, Any]) -> bool:
    """Whether the interval excludes 0 but the test is not significant, or vice versa."""
    if test["interval"] is None:
        return False
    low, high = test["interval"]
    return bool(low > 0 or high < 0) != bool(test["p"] < ALPHA)


def _agreements(agreements: Sequence[Mapping[str, Any]]) -> Table:
    rows = []
    for question in agreements:
        of = question["agreement"]
        share = f"{of['n_equal']}/{of['n_items']}"
        beside = bracketed(of["interval"], "{:.2f}".format)
        fleiss = f"(n={of['n_fleiss']}, {of['n_raters']} each)" if of["fleiss"] is not None else ""
        cells = (Cell(str(of["n_annotators"])), Cell(share), Cell(_coefficient(of["alpha"]), beside))
        last = (Cell(_coefficient(of["fleiss"]), fleiss), Cell(_coefficient(of["ac1"])))
        rows.append(TableRow(question["ask"], (*cells, *last)))
    return Table(
        name="agreement",
        caption="Agreement of annotators.",
        head="question",
        columns=(*("annotators", "all equal", "Krippendorff's alpha", "Fleiss' kappa", "Gwet's AC1"),),
        rows=tuple(rows),
        notes=(
            "1: full agreement, 0: chance level; over items with at least two answers; 'cannot tell' is an answer; in "
            "brackets the 95 % confidence interval over items",
        ),
    )


def _pairs(pairs: Sequence[tuple[str, Mapping[str, Any]]]) -> Table:
    rows = [
        (f"{pair['left']}, {pair['right']}", ask, f"{pair['n_equal']}/{pair['n']}", _coefficient(pair["kappa"]))
        for ask, pair in pairs
    ]
    return text_table(
        "pairs",
        [("annotators", "question", "equal", "Cohen's kappa"), *rows],
        caption="Agreement of each pair of annotators.",
        notes=("over the items that both judged; -: undefined (no items, or only one answer used)",),
    )


def _coefficient(value: float | None) -> str:
    return NOT_MEASURED if value is None else f"{value:.3f}"


def _confusion(confusion: Mapping[str, Any], rule: str) -> Table:
    columns = [k for k, _ in enumerate(confusion["choices"]) if any(row[k] for row in confusion["counts"])]
    header = ["judgements", *(f"ground truth: {confusion['choices'][k]}" for k in columns)]
    rows = [
        [f"annotators: {choice}", *(str(counts[k]) for k in columns)]
        for choice, counts in zip(confusion["choices"], confusion["counts"], strict=True)
    ]
    n = confusion["n"]
    share = f"{confusion['n_equal']} of {n} judgements agree with the ground truth" if n else "no judgement is clear"
    return text_table(
        f"confusion-{confusion['ask']}",
        [header, *rows],
        caption=f"Annotators compared with ground truth: {confusion['ask']}.",
        notes=(f"{share}; Cohen's kappa {_coefficient(confusion['kappa'])}; ground truth: {rule}",),
    )
