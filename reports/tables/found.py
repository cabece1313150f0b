"""What methods found in scenes that nothing scores, and why nothing does, each reason once."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from su3d_bench.core.english import is_countable, plural
from su3d_bench.core.errors import counted
from su3d_bench.formats.tables.table import NOT_MEASURED, Table, text_table

MOST_NAMES = 8  # of a scene that are shown; the rest is counted
UNNAMED = "without a name"


@dataclass(frozen=True)
class Found:
    """The map of a method in a scene; ``n_instances`` is None where it holds features alone, ``update_ms`` where the
    method looks at no frame.

    ``names``: how many instances have a name, the most frequent first; ``extents_m``: the longest edges of the boxes of
    the smallest, the median and the largest instance.
    """

    scene: str
    method: str
    n_points: int
    n_instances: int | None
    names: tuple[tuple[str, int], ...]
    extents_m: tuple[float, float, float] | None
    n_updates: int
    update_ms: float | None


@dataclass(frozen=True)
class Unscored:
    """Why a protocol does not score a map."""

    scene: str
    method: str
    protocol: str
    why: str


def found_table(rows: Sequence[Found], run: str = "") -> Table:
    """A row a scene and method; ``run`` is named where there are several."""
    head = ["scene", "method", "instances", "points", "smallest / median / largest (m)", "updates", "ms an update"]
    body = [
        [
            row.scene,
            row.method,
            NOT_MEASURED if row.n_instances is None else str(row.n_instances),
            f"{row.n_points:,}",
            NOT_MEASURED if row.extents_m is None else " / ".join(f"{extent:.2f}" for extent in row.extents_m),
            str(row.n_updates),
            NOT_MEASURED if row.update_ms is None else f"{row.update_ms:.0f}",
            names_text(row.names),
        ]
        for row in rows
    ]
    note = "sizes: longest edges of the instances' boxes; ms an update: the median, perception included"
    of = run and f": {run}"
    return text_table("found", [[*head, "names"], *body], heading="Found, not scored", caption=of, notes=(note,))


def names_text(names: Sequence[tuple[str, int]], most: int = MOST_NAMES) -> str:
    """The most frequent names with their numbers.

    >>> names_text((("chair", 3), ("sofa", 1), ("", 2))), names_text((("lamp", 1), ("bed", 1)), most=1)
    ('3 chairs, sofa, 2 without a name', 'lamp and 1 name more')
    """
    if not names:
        return NOT_MEASURED
    shown = ", ".join(_of_name(name, n) for name, n in names[:most])
    n_more = len(names) - most
    return f"{shown} and {counted(n_more, 'name')} more" if n_more > 0 else shown


def _of_name(name: str, n: int) -> str:
    if not name.strip():
        return f"{n} {UNNAMED}"
    return name if n == 1 else f"{n} {plural(name) if is_countable(name) else name}"


def not_scored_lines(reasons: Iterable[Unscored]) -> list[str]:
    """One line a protocol, protocols of one reason together, scenes that lack the same as the first of them alone."""
    of_kind: dict[tuple[str, tuple[str, ...]], list[Unscored]] = {}
    for reason in reasons:
        of_kind.setdefault((reason.protocol, _kind(reason)), []).append(reason)
    protocols: dict[tuple[str, str, int], list[str]] = {}
    for (protocol, _), alike in of_kind.items():
        first = alike[0]
        why = first.why if first.why.startswith(first.scene) else f"{first.scene}: {first.why}"
        methods = ", ".join(dict.fromkeys(reason.method for reason in alike))
        n_scenes = len({reason.scene for reason in alike})
        protocols.setdefault((methods, why, n_scenes), []).append(protocol)
    return [
        f"{methods}: not scored under {', '.join(names)}: {why}{f' (and alike in {n - 1} more)' if n > 1 else ''}"
        for (methods, why, n), names in protocols.items()
    ]


def _kind(reason: Unscored) -> tuple[str, ...]:
    """The words of a reason that are not of its scene: no path, and nothing that holds the scene's name."""
    own = reason.scene.rpartition("/")[2]
    return tuple(word for word in reason.why.split() if "/" not in word and own not in word)
