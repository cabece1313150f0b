"""Numbers as papers report them, with source and set-up; they are shown beside measured ones, never among them."""

from __future__ import annotations

from collections.abc import Mapping
from decimal import Decimal
from functools import cache
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from su3d_bench.core.errors import ConfigError, printable, reading, suggest
from su3d_bench.core.system.files import file_bytes
from su3d_bench.core.toml import parse_toml

FILE = Path(__file__).resolve().parent / "published.toml"
MOST_BYTES = 1 << 20
Number = Annotated[str, Field(pattern=r"^\d*\.?\d+$")]  # as printed: the number of decimals says something
PaperTable = Literal["I", "II", "III", "IV", "V", "reasoning"]  # the last is of the text alone


OPEN = "open"  # no source that was read says it
Fact = Annotated[str, Field(min_length=1, max_length=200)]


class System(BaseModel):
    """What made a printed number, as far as a source says.

    ``labels`` a mask or point; ``time`` of a scene or frame, with hardware; ``frames`` that were used; ``proposals``:
    what finds masks, and on what it was trained.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    name: Annotated[str, Field(min_length=1)] = OPEN
    labels: Fact = OPEN
    time: Fact = OPEN
    frames: Fact = OPEN
    proposals: Fact = OPEN

    @property
    def words(self) -> str:
        """What is known, and then what is open.

        >>> System(labels="one").words
        'labels a mask: one; time, frames, proposals: open'
        """
        facts = {"labels a mask": self.labels, "time": self.time, "frames": self.frames, "proposals": self.proposals}
        known = [f"{what}: {fact}" for what, fact in facts.items() if fact != OPEN]
        unknown = ", ".join(what for what, fact in facts.items() if fact == OPEN)
        return "; ".join([*known, *([f"{unknown}: {OPEN}"] if unknown else [])])


class Figure(BaseModel):
    """One printed row: ``values`` is metric -> number as printed, in ``unit``; ``system`` is what made it.

    ``table`` and ``row``: the table of OpenSU3D's paper in which it stands, and its label there. ``protocol``: ours
    that comes nearest to the set-up. ``read_from``: the paper itself, or somebody who quotes it.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    method: Annotated[str, Field(min_length=1)]
    dataset: Annotated[str, Field(min_length=1)]
    setup: Annotated[str, Field(min_length=1)]
    source: Annotated[str, Field(min_length=1)]
    read_from: Literal["paper", "quoted"] = "paper"
    unit: Literal["percent", "fraction"] = "percent"
    values: Annotated[dict[str, Number], Field(min_length=1)]
    system: System = System()
    protocol: str | None = None
    table: PaperTable | None = None
    row: str | None = None
    note: str | None = None

    def percent(self, metric: str) -> str | None:
        """The number in per cent with the decimals that it was printed with; None where it was not printed.

        >>> Figure(method="a", dataset="b", setup="c", source="d", unit="fraction", values={"AP": ".204"}).percent("AP")
        '20.4'
        """
        text = self.values.get(metric)
        if text is None or self.unit == "percent":
            return text
        return f"{Decimal(text).scaleb(2):f}"


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    figure: tuple[Figure, ...]
    system: tuple[System, ...] = ()


def read_published(path: Path = FILE) -> tuple[Figure, ...]:
    """Every figure of a file such as ``published.toml``; ``ConfigError`` with one line where it is not of that form."""
    shown = printable(path.name, 100)
    with reading(shown, ConfigError):
        content = file_bytes(path)
    if len(content) > MOST_BYTES:
        raise ConfigError(f"{shown}: has {len(content)} bytes; expected at most {MOST_BYTES}")
    try:
        table = parse_toml(content.decode("utf-8"))
    except ValueError as error:
        raise ConfigError(f"{shown}: is no TOML: {printable(str(error), 200)}") from error
    try:
        # as a Python value, not through JSON: a number that is no text must stay a number, to be refused
        lists = {name: tuple(table.get(name, ())) for name in ("figure", "system")}
        systems = {entry["name"]: entry for entry in lists["system"] if isinstance(entry, dict) and "name" in entry}
        lists["figure"] = tuple(_with_system(entry, systems, shown, k) for k, entry in enumerate(lists["figure"], 1))
        return _File.model_validate({**table, **lists}).figure
    except (ValidationError, TypeError) as error:
        raise ConfigError(_explain(error, table, shown)) from error


def _with_system(entry: object, systems: Mapping[str, object], shown: str, number: int) -> object:
    """An entry of the file with its system itself in place of the name."""
    if not isinstance(entry, dict) or not isinstance(entry.get("system"), str):
        return entry
    if entry["system"] not in systems:
        name = printable(entry["system"], 60)
        raise ConfigError(f"{shown}: figure {number}: no [[system]] is called '{name}'{suggest(name, systems)}")
    return {**entry, "system": systems[entry["system"]]}


def _explain(error: ValidationError | TypeError, table: dict[str, object], shown: str) -> str:
    if isinstance(error, TypeError):
        return f"{shown}: 'figure' or 'system' is no list; write each as [[figure]] or [[system]]"
    faults = error.errors()
    # a misspelt key is also a missing one; the misspelling says more
    first = next((fault for fault in faults if fault["type"] == "extra_forbidden"), faults[0])
    place = [str(part) for part in first["loc"]]
    where = shown
    if len(place) > 1:
        where = f"{shown}: {place[0]} {int(place[1]) + 1}"
    key = printable(".".join(place[2:]) or ".".join(place), 100)
    reason = first["msg"][:1].lower() + first["msg"][1:]
    value = "" if first["type"] in {"missing", "extra_forbidden"} else f" = {printable(repr(first['input']), 80)}"
    return f"{where}: {key}{value}: {reason}"


@cache
def published() -> tuple[Figure, ...]:
    """What papers report, as this package has it."""
    return read_published()


def figures_of(*, is_wanted: bool = True, **fields: str) -> list[Figure]:
    """What is reported where each of ``fields`` is as given, such as ``method="sam3d"``; none where not wanted."""
    figures = published() if is_wanted else ()
    return [figure for figure in figures if all(getattr(figure, name) == value for name, value in fields.items())]
