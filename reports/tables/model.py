"""A table before it has a format: rows of cells that know the run or the print that they come from."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from su3d_bench.core.registry import CEILING_METHOD
from su3d_bench.numerics.statistics import FEW_SCENES, Interval, SignFlipTest

NOT_MEASURED = "-"
What = Literal["value", "ceiling", "scenes"]
Unit = Literal["percent", "fraction"]


def percent(value: float | None) -> str:
    """A fraction in per cent with one decimal, as papers of this field print it; ``-`` where there is none."""
    return NOT_MEASURED if value is None else f"{100.0 * value:.1f}"


def signed(value: float | None) -> str:
    """A difference of fractions in percentage points, with its sign; ``-`` where there is none.

    >>> signed(0.0123), signed(-0.00001), signed(None)
    ('+1.2', '0.0', '-')
    """
    if value is None:
        return NOT_MEASURED
    text = f"{100 * value:+.1f}"
    return "0.0" if float(text) == 0 else text


def bracketed(interval: Sequence[float] | None, show: Callable[[float], str] = percent) -> str:
    """The ends of an interval as ``show`` has them; nothing where there is none.

    >>> bracketed((0.1, 0.25)), bracketed(None)
    ('[10.0, 25.0]', '')
    """
    return "" if interval is None else f"[{show(interval[0])}, {show(interval[1])}]"


def few_scenes(n_scenes: int) -> str | None:
    """What must stand beneath intervals over so few scenes; None where they are enough, or where none has any.

    >>> few_scenes(4)
    'intervals over 4 scenes are rough, as all over fewer than 10: docs/numbers/statistics.md'
    """
    if not 1 < n_scenes < FEW_SCENES:
        return None
    return (
        f"intervals over {n_scenes} scenes are rough, as all over fewer than {FEW_SCENES}: docs/numbers/statistics.md"
    )


def with_interval(value: float | None, interval: Sequence[float] | None) -> str:
    """A fraction in per cent, its interval behind it."""
    return f"{percent(value)} {bracketed(interval)}".rstrip()


REFINED_LABELS = "label n: the name given while mapping; n': the name chosen afterwards from the instance's best views"


def label_notes(names: Iterable[str]) -> list[str]:
    """What the paper's marks in the names of metrics mean, where one has them."""
    return [REFINED_LABELS] if any(name.endswith((" n", " n'")) for name in names) else []


def is_count(metric: str) -> bool:
    """Whether a metric is a number of something and no share, by its name as in ``metrics.json``."""
    return metric.startswith("n_")


@dataclass(frozen=True)
class Origin:
    """Which number of which run a cell shows; ``value`` is a fraction, or the number of scored scenes.

    ``unit``: in what the cell shows a share.
    """

    run: str
    method: str
    protocol: str
    version: int
    metric: str
    what: What
    value: float
    interval: Interval | None = None
    unit: Unit = "percent"


@dataclass(frozen=True)
class Cell:
    """``text`` as it is shown, without the mark of the best, and ``beside`` it what is never marked, as an interval.

    ``origin`` is None for what a paper reports.
    """

    text: str
    beside: str = ""
    is_best: bool = False
    origin: Origin | None = None

    @property
    def whole(self) -> str:
        return f"{self.text} {self.beside}" if self.beside else self.text


@dataclass(frozen=True)
class TableRow:
    """``mark`` points to the note that says where a reported row is from; ``group``: rows that are compared."""

    label: str
    cells: tuple[Cell, ...]
    is_reported: bool = False
    mark: str = ""
    group: str = ""

    @property
    def title(self) -> str:
        """The label, with what must stand beside it in any format."""
        return f"{self.label} (as reported [{self.mark}])" if self.is_reported else self.label


@dataclass(frozen=True)
class Table:
    """``name`` is short and for references; ``head`` titles the first column, ``columns`` those of the cells.

    ``heading`` begins the caption, and stands out where the format has bold type.
    """

    name: str
    caption: str
    head: str
    columns: tuple[str, ...]
    rows: tuple[TableRow, ...]
    notes: tuple[str, ...]
    heading: str = ""


@dataclass(frozen=True)
class Prose:
    """What stands above, between or beneath tables: the lines of a paragraph, or of a list."""

    lines: tuple[str, ...]
    is_list: bool = False


def text_table(
    name: str, rows: Sequence[Sequence[str]], *, heading: str = "", caption: str = "", notes: Iterable[str] = ()
) -> Table:
    """A table of texts that stand for no number of a run alone; the first of ``rows`` is the header."""
    (head, *columns), *body = rows
    table_rows = tuple(TableRow(label, tuple(map(Cell, cells))) for label, *cells in body)
    return Table(name, caption, head, tuple(columns), table_rows, tuple(notes), heading)


def blocks_of(rows: Sequence[TableRow]) -> list[list[TableRow]]:
    """Rows that belong together, in order: measured before reported, one group after the other."""
    blocks: list[list[TableRow]] = []
    for row in rows:
        if blocks and (blocks[-1][-1].is_reported, blocks[-1][-1].group) == (row.is_reported, row.group):
            blocks[-1].append(row)
        else:
            blocks.append([row])
    return blocks


BY_PEOPLE = "-people"  # ends the name of what stands in a protocol's place where people judged


def confidence_notes(confidences: Mapping[str, str | None]) -> list[str]:
    """Where the confidences behind average precision come from, for each row that has one; a mix is marked.

    >>> confidence_notes({"a": "computed", "b": "1 for all", "c": "1 for all"})
    ['MIXED CONFIDENCES: computed (a); 1 for all (b, c): these average precisions do not compare']
    """
    whose: dict[str, list[str]] = {}
    for label, what in confidences.items():
        if what is not None:
            whose.setdefault(what, []).append(label)
    if len(whose) < 2:
        return [f"confidences: {what}" for what in whose]
    told = "; ".join(f"{what} ({', '.join(labels)})" for what, labels in whose.items())
    return [f"MIXED CONFIDENCES: {told}: these average precisions do not compare"]


def is_ceiling(method: str, caveat: str | None) -> bool:
    """Whether a row was told the truth, and competes with none."""
    return method == CEILING_METHOD or "a ceiling, not a result" in (caveat or "")


def label_count_notes(labels: Mapping[str, str | None]) -> list[str]:
    """That rows are of other numbers of labels a mask or point, which do not compare; nothing where all are of one.

    >>> label_count_notes({"a": "one label", "b": "the top 5 labels", "c": None})
    ['MIXED LABELS: one label (a); the top 5 labels (b): these numbers do not compare']
    """
    whose: dict[str, list[str]] = {}
    for row, what in labels.items():
        if what is not None:
            whose.setdefault(what, []).append(row)
    told = "; ".join(f"{what} ({', '.join(rows)})" for what, rows in whose.items())
    return [f"MIXED LABELS: {told}: these numbers do not compare"] if len(whose) > 1 else []


@dataclass(frozen=True, kw_only=True)
class Measured:
    """The numbers of ``metrics.json`` for one method and protocol, as fractions, None where undefined.

    What people judged is of this form too, from ``scores.json`` instead. ``run`` is the folder as it was named;
    ``limit``: how many frames of a scene, 0 for all; ``ceilings`` are empty where there is none. ``per_scene`` is
    scene -> metric -> value; ``changed``: settings other than the method's own; ``warnings`` are what was said of the
    numbers when they were made, ``tests`` what people's judgements of the same items say, by metric and other method.
    """

    run: str
    method: str
    protocol: str
    version: int
    kind: str
    headline: tuple[str, ...]
    metrics: Mapping[str, float | None]
    intervals: Mapping[str, Interval | None]
    per_scene: Mapping[str, Mapping[str, float | None]]
    ceilings: Mapping[str, float | None] = field(default_factory=dict)
    n_planned: int
    failed: tuple[str, ...] = ()
    unscored: tuple[str, ...] = ()
    limit: int = 0
    profile: str | None = None
    encoder: str | None = None
    confidences: str | None = None
    caveat: str | None
    warnings: tuple[str, ...] = ()
    changed: tuple[str, ...] = ()
    tests: Mapping[tuple[str, str], SignFlipTest] = field(default_factory=dict)

    @property
    def is_by_people(self) -> bool:
        return self.protocol.endswith(BY_PEOPLE)

    @property
    def scenes(self) -> frozenset[str]:
        return frozenset(self.per_scene)

    @property
    def datasets(self) -> str:
        """The datasets of the scenes, which are named ``dataset/scene``."""
        return ", ".join(dict.fromkeys(scene.partition("/")[0] for scene in self.per_scene)) or "no scene"

    @property
    def scenes_text(self) -> str:
        """``8``, ``7/8`` where some are missing, ``8 partial`` where only the first frames were used."""
        n = len(self.per_scene)
        text = str(n) if n == self.n_planned else f"{n}/{self.n_planned}"
        return f"{text} partial" if self.limit else text

    @property
    def is_whole(self) -> bool:
        return len(self.per_scene) == self.n_planned and not self.limit

    @property
    def is_ceiling(self) -> bool:
        """Whether the method was told the truth, or where to look for it, so that it competes with none."""
        return is_ceiling(self.method, self.caveat)
