"""The measured numbers shown in tables, and the notes below them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from su3d_bench.core.registry import CEILING_METHOD, base_name
from su3d_bench.core.types import Interval
from su3d_bench.numerics.statistics import FEW_SCENES, SignFlipTest


def few_scenes(n_scenes: int) -> str | None:
    """Return the warning for intervals over few scenes; None for a single scene (no interval) or enough scenes.

    >>> few_scenes(4)
    'intervals from fewer than 10 scenes are unreliable (here: 4)'
    """
    if not 1 < n_scenes < FEW_SCENES:
        return None
    return f"intervals from fewer than {FEW_SCENES} scenes are unreliable (here: {n_scenes})"


REFINED_LABELS = "label n: the name given while mapping; n': the name chosen afterwards from the instance's best views"


def label_notes(names: Iterable[str]) -> list[str]:
    """Explain the paper's marks n and n' if the name of a metric has one."""
    return [REFINED_LABELS] if any(name.endswith((" n", " n'")) for name in names) else []


ANNOTATED_SUFFIX = "-people"  # suffix of the protocol name of results judged by annotators


def confidence_notes(confidences: Mapping[str, str | None]) -> list[str]:
    """Return the origin of the confidences behind average precision for the rows that have one; a mix is marked.

    >>> confidence_notes({"a": "computed", "b": "1 for all", "c": "1 for all"})
    ['MIXED CONFIDENCES: computed (a); 1 for all (b, c): average precisions are not comparable']
    """
    whose = _rows_by(confidences)
    if len(whose) < 2:
        return [f"confidences: {what}" for what in whose]
    return [f"MIXED CONFIDENCES: {_listing(whose)}: average precisions are not comparable"]


def _rows_by(values: Mapping[str, str | None]) -> dict[str, list[str]]:
    whose: dict[str, list[str]] = {}
    for row, what in values.items():
        if what is not None:
            whose.setdefault(what, []).append(row)
    return whose


def _listing(whose: Mapping[str, Iterable[str]]) -> str:
    return "; ".join(f"{what} ({', '.join(rows)})" for what, rows in whose.items())


def is_ceiling(method: str, caveat: str | None) -> bool:
    """Whether a row uses ground truth, so that it is not ranked."""
    return base_name(method) == CEILING_METHOD or "a ceiling, not a result" in (caveat or "")


def label_count_notes(labels: Mapping[str, str | None]) -> list[str]:
    """Return a warning if rows use different numbers of labels per mask or point; empty if all are the same.

    >>> label_count_notes({"a": "one label", "b": "the top 5 labels", "c": None})
    ['MIXED LABELS: one label (a); the top 5 labels (b): numbers are not comparable']
    """
    whose = _rows_by(labels)
    return [f"MIXED LABELS: {_listing(whose)}: numbers are not comparable"] if len(whose) > 1 else []


@dataclass(frozen=True, kw_only=True)
class Measured:
    """The numbers of ``metrics.json`` for one method and protocol, as fractions, None where undefined.

    Annotators' judgements, from ``scores.json``, have this form too. ``run``: the folder as given by the user;
    ``limit``: frames per scene, 0 for all; ``ceilings``: empty if unknown; ``per_scene``: scene -> metric -> value;
    ``changed``: settings that differ from the method's defaults; ``warnings``: those recorded with the numbers;
    ``tests``: paired tests on annotators' judgements of the same items, by metric and other method.
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
        """The datasets of the scenes, whose names are ``dataset/scene``."""
        return ", ".join(dict.fromkeys(scene.partition("/")[0] for scene in self.per_scene)) or "no scene"

    @property
    def scenes_text(self) -> str:
        """``8``, ``7/8`` if some are missing, ``8 partial`` if only the first frames were used."""
        n = len(self.per_scene)
        text = str(n) if n == self.n_planned else f"{n}/{self.n_planned}"
        return f"{text} partial" if self.limit else text

    @property
    def is_whole(self) -> bool:
        return len(self.per_scene) == self.n_planned and not self.limit

    @property
    def is_ceiling(self) -> bool:
        """Whether the method uses ground truth, if only to choose where to look, so that it is not ranked."""
        return is_ceiling(self.method, self.caveat)
