"""A paper's experiments as a recipe: a small TOML with methods, scenes, protocols and the figures that it printed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from su3d_bench.core.errors import ConfigError, printable, reading, suggest
from su3d_bench.core.system.files import file_bytes, parse_toml
from su3d_bench.reports.tables.paper import Figure, PaperTable, published

FOLDER = Path(__file__).resolve().parent / "recipes"
MOST_BYTES = 1 << 20
EVERY_ROW = "*"
Word = Annotated[str, Field(min_length=1, max_length=400)]
_STRICT = ConfigDict(extra="forbid", frozen=True, strict=True)


class Experiment(BaseModel):
    """What a paper did for one table, figure or number.

    ``methods``: as ``run --methods`` takes them; ``vary``: a sweep over settings of ``varied``, as ``ablate --vary``
    takes it. ``scenes`` are addresses, several datasets may be among them. ``protocols``: the first that scored stands
    beside the figure. ``encoder``: a model's name, None for the recipe's own. ``stride`` 0: each method's own.
    ``table``: the table of OpenSU3D's paper whose form it has. ``figures``: which of ``published.toml`` stand beside,
    each by the fields that it must have. ``metrics``: printed row ('*': every one) -> printed metric -> the protocol's
    name of it. ``predictions``: printed methods that are none here, whose predictions are taken. ``queries``: texts
    whose heat maps are drawn. ``timing``: the times of updates are its answer.
    """

    model_config = _STRICT

    name: Word
    title: Word
    methods: tuple[Word, ...] = ()
    varied: Word = "opensu3d"
    vary: tuple[Word, ...] = ()
    scenes: Annotated[tuple[Word, ...], Field(min_length=1)]
    protocols: tuple[Word, ...] = ()
    encoder: Word | None = None
    stride: Annotated[int, Field(ge=0)] = 0
    table: PaperTable | None = None
    figures: tuple[dict[Word, Word], ...] = ()
    metrics: dict[Word, dict[Word, Word]] = {}
    predictions: tuple[Word, ...] = ()
    queries: tuple[Word, ...] = ()
    timing: bool = False
    note: str = ""

    @model_validator(mode="after")
    def _has_work(self) -> Experiment:
        if not (self.methods or self.vary or self.predictions):
            raise ValueError("names no methods, no vary and no predictions, so that there is nothing to do")
        return self

    def printed(self) -> list[Figure]:
        """The figures that stand beside, each once; a ``ConfigError`` where a choice finds none."""
        known = set(Figure.model_fields)
        found: list[Figure] = []
        for choice in self.figures:
            unknown = next((key for key in choice if key not in known), None)
            if unknown is not None:
                raise ConfigError(
                    f"experiment {self.name}: figures have no '{printable(unknown, 60)}'{suggest(unknown, known)}"
                )
            figures = [one for one in published() if all(getattr(one, key) == said for key, said in choice.items())]
            if not figures:
                said = ", ".join(f"{key} = {value}" for key, value in choice.items())
                raise ConfigError(f"experiment {self.name}: published.toml holds no figure of {printable(said, 200)}")
            found += [figure for figure in figures if figure not in found]
        return found

    def metric(self, figure: Figure, printed: str) -> str:
        """What the protocol calls the metric that is ``printed`` in a row."""
        named = {**self.metrics.get(EVERY_ROW, {}), **self.metrics.get(figure.row or "", {})}
        return named.get(printed, printed)


class Rehearsal(BaseModel):
    """The same on rooms that the program makes: their names, options of them, and whose perception."""

    model_config = _STRICT

    rooms: Annotated[tuple[Word, ...], Field(min_length=1)] = ("bedroom0", "office0")
    settings: tuple[Word, ...] = ("n_frames=100", "width=240", "height=180")
    profile: Literal["embedded", "oracle"] = "embedded"


class Recipe(BaseModel):
    """A paper's experiments. ``settings`` are KEY=VALUE as ``run --set`` takes them, of all its runs."""

    model_config = _STRICT

    schema_version: Annotated[Literal[1], Field(alias="schema")]
    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,60}$")]
    title: Word
    profile: Word = "paper"
    encoder: Word = "clip-vit-h-14"
    settings: tuple[Word, ...] = ()
    experiments: Annotated[tuple[Experiment, ...], Field(alias="experiment", min_length=1)]
    rehearsal: Rehearsal = Rehearsal()

    @model_validator(mode="after")
    def _named_once(self) -> Recipe:
        names = [one.name for one in self.experiments]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise ValueError(f"two experiments are called '{twice}'")
        return self

    def chosen(self, names: Sequence[str]) -> tuple[Experiment, ...]:
        """The experiments of these names, all where none is named, each with its encoder; a ``ConfigError`` for an
        unknown one."""
        known = {one.name: one.model_copy(update={"encoder": one.encoder or self.encoder}) for one in self.experiments}
        for name in names:
            if name not in known:
                raise ConfigError(f"recipe '{self.name}' has no table '{printable(name, 60)}'{suggest(name, known)}")
        return tuple(known[name] for name in dict.fromkeys(names or known))


def recipe_names() -> tuple[str, ...]:
    """The recipes that the program brings."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.toml")))


def load_recipe(name: str) -> Recipe:
    """The recipe of this name, or the one in this file of somebody's own; ``ConfigError`` where it is none."""
    return parse_recipe(recipe_bytes(name), printable(Path(name).name if name.endswith(".toml") else name, 100))


def recipe_bytes(name: str) -> bytes:
    """The file of a recipe, of the program's own or by path."""
    if not name.endswith(".toml") and name not in recipe_names():
        hint = suggest(name, recipe_names())
        raise ConfigError(f"no recipe is called '{printable(name, 80)}'{hint}; or name a file of your own, mine.toml")
    path = Path(name) if name.endswith(".toml") else FOLDER / f"{name}.toml"
    with reading(printable(str(path), 200), ConfigError):
        content = file_bytes(path)
    if len(content) > MOST_BYTES:
        raise ConfigError(f"{printable(path.name, 100)}: has {len(content)} bytes; expected at most {MOST_BYTES}")
    return content


def parse_recipe(content: bytes, shown: str) -> Recipe:
    """The recipe that ``content`` is; ``shown`` begins the line of a ``ConfigError`` where it is none."""
    try:
        table = parse_toml(content.decode("utf-8"))
    except ValueError as error:
        raise ConfigError(f"{shown}: is no TOML: {printable(str(error), 200)}") from error
    try:
        recipe = Recipe.model_validate(_tuples(table))
        for experiment in recipe.experiments:
            experiment.printed()
    except ValidationError as error:
        raise ConfigError(f"{shown}: {_explained(error)}") from error
    except ConfigError as error:
        raise ConfigError(f"{shown}: {error}") from error
    return recipe


def _tuples(value: object) -> object:
    """``value`` with tuples for lists: a strict model takes no list for a tuple."""
    if isinstance(value, Mapping):
        return {key: _tuples(item) for key, item in value.items()}
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def _explained(error: ValidationError) -> str:
    faults = error.errors()
    first = next((fault for fault in faults if fault["type"] == "extra_forbidden"), faults[0])
    places = [f"{int(part) + 1}" if isinstance(part, int) else str(part) for part in first["loc"]]
    reason = first["msg"].removeprefix("Value error, ")
    reason = reason[:1].lower() + reason[1:]
    where = printable(" ".join(places), 120) or "the recipe"
    if first["type"] == "extra_forbidden":
        fields = Experiment.model_fields if places[0] == "experiment" else Recipe.model_fields
        known = [field.alias or name for name, field in fields.items()]
        return f"{where}: unknown key{suggest(places[-1], known)}"
    return f"{where}: {printable(reason, 200)}"
