"""The measured numbers that tables show, and the notes beneath them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from su3d_bench.core.registry import CEILING_METHOD
from su3d_bench.core.types import Interval
from su3d_bench.numerics.statistics import FEW_SCENES, SignFlipTest


def few_scenes(n_scenes: int) -> str | None:
    """What must stand beneath intervals over so few scenes; None where they are enough, or where none has any.

    >>> few_scenes(4)
    'intervals from fewer than 10 scenes are unreliable (here: 4): docs/numbers/statistics.md'
    """
    if not 1 < n_scenes < FEW_SCENES:
        return None
    return (
        f"intervals from fewer than {FEW_SCENES} scenes are unreliable (here: {n_scenes}): docs/numbers/statistics.md"
    )


REFINED_LABELS = "label n: the name given while mapping; n': the name chosen afterwards from the instance's best views"


def label_notes(names: Iterable[str]) -> list[str]:
    """What the paper's marks in the names of metrics mean, where one has them."""
    return [REFINED_LABELS] if any(name.endswith((" n", " n'")) for name in names) else []


ANNOTATED_SUFFIX = "-people"  # ends the name of what stands in a protocol's place where people judged


def confidence_notes(confidences: Mapping[str, str | None]) -> list[str]:
    """Where the confidences behind average precision come from, for each row that has one; a mix is marked.

    >>> confidence_notes({"a": "computed", "b": "1 for all", "c": "1 for all"})
    ['MIXED CONFIDENCES: computed (a); 1 for all (b, c): these average precisions do not compare']
    """
    whose = _rows_by(confidences)
    if len(whose) < 2:
        return [f"confidences: {what}" for what in whose]
    return [f"MIXED CONFIDENCES: {_listing(whose)}: these average precisions do not compare"]


def _rows_by(said: Mapping[str, str | None]) -> dict[str, list[str]]:
    whose: dict[str, list[str]] = {}
    for row, what in said.items():
        if what is not None:
            whose.setdefault(what, []).append(row)
    return whose


def _listing(whose: Mapping[str, Iterable[str]]) -> str:
    return "; ".join(f"{what} ({', '.join(rows)})" for what, rows in whose.items())


def is_ceiling(method: str, caveat: str | None) -> bool:
    """Whether a row was told the truth, and competes with none."""
    return method == CEILING_METHOD or "a ceiling, not a result" in (caveat or "")


def label_count_notes(labels: Mapping[str, str | None]) -> list[str]:
    """That rows are of other numbers of labels a mask or point, which do not compare; nothing where all are of one.

    >>> label_count_notes({"a": "one label", "b": "the top 5 labels", "c": None})
    ['MIXED LABELS: one label (a); the top 5 labels (b): these numbers do not compare']
    """
    whose = _rows_by(labels)
    return [f"MIXED LABELS: {_listing(whose)}: these numbers do not compare"] if len(whose) > 1 else []


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
        return self.protocol.endswith(ANNOTATED_SUFFIX)

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
