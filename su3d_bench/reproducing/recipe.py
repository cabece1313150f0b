"""Recipes of a paper's experiments (TOML files with methods, scenes, protocols and printed figures) and their runs."""

from __future__ import annotations

import fnmatch
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from su3d_bench.core import registry
from su3d_bench.core.config import Settings
from su3d_bench.core.errors import ConfigError, Su3dError, printable, reading, suggest
from su3d_bench.core.files.atomic import is_file
from su3d_bench.core.interfaces import HasGroups
from su3d_bench.core.system.files import file_bytes, parse_toml
from su3d_bench.evaluation.result import Request
from su3d_bench.evaluation.run_output import evaluate_methods
from su3d_bench.metrics.compatibility import TruthFacts, truth_incompatibility
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.reports.tables.ablation import SweepRow
from su3d_bench.reports.tables.paper import Figure, PaperTable, published
from su3d_bench.runs.ablation import ablation_rows, write_rows
from su3d_bench.runs.executors import Report
from su3d_bench.runs.existing import Into
from su3d_bench.runs.job import build_dataset, part_of
from su3d_bench.runs.plan import (
    ASKS,
    USES_LANGUAGE,
    Plan,
    asked_settings,
    asks_language_model,
    flag_of,
    make_plan,
    named_method,
)
from su3d_bench.runs.runner import RunResult, run_plan
from su3d_bench.runs.scenes import data_root, split_address

FOLDER = Path(__file__).resolve().parent / "recipes"
MAX_BYTES = 1 << 20
EVERY_ROW = "*"
Word = Annotated[str, Field(min_length=1, max_length=400)]
_STRICT = ConfigDict(extra="forbid", frozen=True, strict=True)


class Experiment(BaseModel):
    """A paper's experiment for one table, figure or number.

    ``methods``: as in ``run --methods``; ``vary``: a sweep over settings of ``varied``, as in ``ablate --vary``.
    ``scenes``: addresses, possibly of several datasets. ``protocols``: the first that has a score is compared with the
    figure. ``encoder``: a model's name, None for the recipe's. ``stride`` 0: each method's own. ``table``: the table of
    OpenSU3D's paper whose layout is used. ``figures``: the figures of ``published.toml`` to compare with, each selected
    by its fields. ``metrics``: printed row ('*': every row) -> printed metric -> the protocol's name of it.
    ``predictions``: printed methods that are not implemented here, for which predictions are accepted. ``queries``:
    texts whose heat maps are drawn. ``timing``: whether the result is the times of updates.
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
            raise ValueError("has no methods, vary or predictions, so there is nothing to do")
        return self

    def printed(self) -> list[Figure]:
        """The figures to compare with, each once; ``ConfigError`` if a selection matches none."""
        known = set(Figure.model_fields)
        found: list[Figure] = []
        for choice in self.figures:
            unknown = next((key for key in choice if key not in known), None)
            if unknown is not None:
                raise ConfigError(
                    f"experiment {self.name}: figures have no '{printable(unknown, 60)}'{suggest(unknown, known)}"
                )
            figures = [one for one in published() if all(getattr(one, key) == want for key, want in choice.items())]
            if not figures:
                text = ", ".join(f"{key} = {value}" for key, value in choice.items())
                raise ConfigError(f"experiment {self.name}: published.toml has no figure with {printable(text, 200)}")
            found += [figure for figure in figures if figure not in found]
        return found

    def metric(self, figure: Figure, printed: str) -> str:
        """The protocol's name of the metric ``printed`` in a row."""
        named = {**self.metrics.get(EVERY_ROW, {}), **self.metrics.get(figure.row or "", {})}
        return named.get(printed, printed)


class Recipe(BaseModel):
    """A paper's experiments. ``settings``: KEY=VALUE as in ``run --set``, for all its runs."""

    model_config = _STRICT

    schema_version: Annotated[Literal[1], Field(alias="schema")]
    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,60}$")]
    title: Word
    profile: Word = "paper"
    encoder: Word = "clip-vit-h-14"
    settings: tuple[Word, ...] = ()
    experiments: Annotated[tuple[Experiment, ...], Field(alias="experiment", min_length=1)]

    @model_validator(mode="after")
    def _named_once(self) -> Recipe:
        names = [one.name for one in self.experiments]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise ValueError(f"two experiments have the name '{twice}'")
        return self

    def chosen(self, names: Sequence[str]) -> tuple[Experiment, ...]:
        """The experiments of these names (default: all), each with its encoder; ``ConfigError`` for unknown names."""
        known = {one.name: one.model_copy(update={"encoder": one.encoder or self.encoder}) for one in self.experiments}
        for name in names:
            if name not in known:
                raise ConfigError(f"recipe '{self.name}' has no table '{printable(name, 60)}'{suggest(name, known)}")
        return tuple(known[name] for name in dict.fromkeys(names or known))


def recipe_names() -> tuple[str, ...]:
    """The built-in recipes."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.toml")))


def load_recipe(name: str) -> Recipe:
    """The recipe of this name, or the user-defined one in this file; ``ConfigError`` if it is invalid."""
    path = recipe_file(name)
    with reading(printable(str(path), 200), ConfigError):
        content = file_bytes(path)
    if len(content) > MAX_BYTES:
        raise ConfigError(f"{printable(path.name, 100)}: has {len(content)} bytes; expected at most {MAX_BYTES}")
    return parse_recipe(content, printable(path.name if name.endswith(".toml") else name, 100))


def recipe_file(name: str) -> Path:
    """The file of a recipe, built-in or by path."""
    if not name.endswith(".toml") and name not in recipe_names():
        hint = suggest(name, recipe_names())
        raise ConfigError(f"no recipe has the name '{printable(name, 80)}'{hint}; or give a recipe file, mine.toml")
    return Path(name) if name.endswith(".toml") else FOLDER / f"{name}.toml"


def parse_recipe(content: bytes, shown: str) -> Recipe:
    """The recipe in ``content``; ``shown`` is the prefix of the ``ConfigError`` if it is invalid."""
    try:
        table = parse_toml(content.decode("utf-8"))
    except ValueError as error:
        raise ConfigError(f"{shown}: is not valid TOML: {printable(str(error), 200)}") from error
    try:
        recipe = Recipe.model_validate_json(json.dumps(table, default=str))  # strict mode accepts JSON lists as tuples
        for experiment in recipe.experiments:
            experiment.printed()
    except ValidationError as error:
        raise ConfigError(f"{shown}: {_explained(error)}") from error
    except ConfigError as error:
        raise ConfigError(f"{shown}: {error}") from error
    return recipe


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


RUNS = "runs"


@dataclass(frozen=True)
class RecipeRequest:
    """Options for running a recipe; None means the recipe's own value.

    ``values``: further values of a run by key (``jobs``, ``limit``, ``executor`` and others), ``assignments``: as in
    ``run --set``. ``scenes``: dataset -> addresses that replace the recipe's; its other datasets are not used.
    """

    profile: str | None = None
    encoder: str | None = None
    device: str | None = None
    values: Mapping[str, Any] = ()  # type: ignore[assignment]
    assignments: tuple[str, ...] = ()
    scenes: Mapping[str, tuple[str, ...]] | None = None


@dataclass(frozen=True)
class RecipeRun:
    """One run; ``name``: the name of its folder below ``runs/``; ``rows``: the rows of sweeps."""

    name: str
    dataset: str
    profile: str
    encoder: str
    stride: int
    scenes: tuple[str, ...]
    methods: tuple[str, ...]
    protocols: tuple[str, ...]
    settings: tuple[str, ...]
    experiments: tuple[str, ...]
    rows: tuple[SweepRow, ...] = ()
    device: str | None = None
    values: Mapping[str, Any] = ()  # type: ignore[assignment]

    def folder(self, out: Path) -> Path:
        return out / RUNS / self.name


def sweep_rows(experiment: Experiment) -> tuple[SweepRow, ...]:
    """The rows of an experiment that varies settings; empty for others."""
    return ablation_rows(experiment.varied, experiment.vary, is_grid=False) if experiment.vary else ()


def methods_of(experiment: Experiment) -> tuple[str, ...]:
    """The methods that an experiment runs, a sweep's variants first."""
    return tuple(dict.fromkeys([*(row.method for row in sweep_rows(experiment)), *experiment.methods]))


def method_of_row(experiment: Experiment, method: str, row: str | None) -> str:
    """The method of a printed row: a variant of a sweep, ``METHOD@ROW`` if that is run, otherwise the method."""
    for swept in sweep_rows(experiment):
        if row == f"{swept.parameter}={swept.value.strip('[]')}".replace(" ", ""):
            return swept.method
    variant = f"{method}@{row}"
    return variant if variant in experiment.methods else method


def asked_runs(recipe: Recipe, experiments: Sequence[Experiment], asked: RecipeRequest) -> tuple[RecipeRun, ...]:
    """The runs for all ``experiments``; those with the same dataset, encoder and stride are merged into one.

    Raises ``ConfigError`` if a method, protocol or dataset is unknown.
    """
    parts: dict[tuple[str, str, int], list[tuple[Experiment, tuple[str, ...]]]] = {}
    for experiment in experiments:
        for method in methods_of(experiment):
            named_method(method)
        encoder = asked.encoder or experiment.encoder or recipe.encoder
        for dataset, scenes in _by_dataset(experiment, asked).items():
            parts.setdefault((dataset, encoder, experiment.stride), []).append((experiment, scenes))
    used = {dataset for dataset, *_ in parts}
    if foreign := next((name for name in asked.scenes or () if name not in used), None):
        raise ConfigError(f"--scenes: no requested table uses the dataset '{printable(foreign, 60)}'")
    usual = asked.encoder or recipe.encoder
    runs = []
    for (dataset, encoder, stride), mine in parts.items():
        protocols = _joined(_fitting(one, dataset) for one, _ in mine)
        unused = {name for name in ASKS if not any(USES_LANGUAGE[name](load_protocol(one)) for one in protocols)}
        named = dataset, encoder if encoder != usual else "", f"stride{stride}" if stride else ""
        run = RecipeRun(
            name="-".join(filter(None, named)),
            dataset=dataset,
            profile=asked.profile or recipe.profile,
            encoder=encoder,
            stride=stride,
            scenes=_joined(scenes for _, scenes in mine),
            methods=_joined(methods_of(one) for one, _ in mine),
            protocols=protocols,
            settings=(*recipe.settings, f"perception.models.encoder={encoder}", *asked.assignments),
            experiments=tuple(one.name for one, _ in mine),
            rows=_joined(sweep_rows(one) for one, _ in mine),
            device=asked.device,
            values={name: value for name, value in dict(asked.values).items() if name not in unused},
        )
        runs += [run] if run.methods else []
    for name in asks_language_model(dict(asked.values)):
        if not any(name in run.values for run in runs):
            raise ConfigError(f"{flag_of(name)}: no requested table uses it; add --tables reasoning")
    return tuple(runs)


def _joined(parts: Iterable[Sequence[Any]]) -> tuple[Any, ...]:
    return tuple(dict.fromkeys(chain.from_iterable(parts)))


def _by_dataset(experiment: Experiment, asked: RecipeRequest) -> dict[str, tuple[str, ...]]:
    by_dataset: dict[str, tuple[str, ...]] = {}
    for address in experiment.scenes:
        dataset, scene = split_address(address)
        if not scene or (dataset not in registry.names("dataset") and ".py:" not in dataset):
            raise ConfigError(f"experiment {experiment.name}: '{printable(address, 100)}' is not a scene of a dataset")
        by_dataset[dataset] = (*by_dataset.get(dataset, ()), address)
    if asked.scenes is None:
        return by_dataset
    return {dataset: asked.scenes[dataset] for dataset in by_dataset if dataset in asked.scenes}


def _fitting(experiment: Experiment, dataset: str) -> tuple[str, ...]:
    """The experiment's protocols that can score a dataset; ``ConfigError`` if there is none."""
    truth = TruthFacts.of_dataset(registry.load("dataset", dataset))
    names = tuple(name for name in experiment.protocols if truth_incompatibility(load_protocol(name), truth) is None)
    if experiment.protocols and not names:
        raise ConfigError(f"experiment {experiment.name}: none of its protocols fits the dataset '{dataset}'")
    return names


def dataset_named(name: str) -> Any:
    return build_dataset(part_of("dataset", name, Settings()), data_root())


def known_scenes(dataset: Any) -> tuple[str, ...]:
    try:
        return tuple(dataset.scenes())
    except Su3dError:
        return ()


def scene_names(dataset_name: str, addresses: Sequence[str]) -> Iterator[str]:
    """The scenes named by ``addresses`` of a dataset; groups are expanded, patterns match available scenes."""
    dataset = dataset_named(dataset_name)
    groups = dataset.groups() if isinstance(dataset, HasGroups) else {}
    for address in addresses:
        _, name = split_address(address)
        if any(character in name for character in "*?["):
            yield from (scene for scene in known_scenes(dataset) if fnmatch.fnmatchcase(scene, name))
        else:
            yield from groups.get(name, (name,))


def plan_of(run: RecipeRun, out: Path) -> Plan:
    """The plan of a run; it extends a run already in its folder, so that tables can be added later."""
    values = dict(run.values) | {
        "scenes": run.scenes,
        "methods": run.methods,
        "protocols": run.protocols,
        "profile": run.profile,
        "stride": run.stride or None,
        "pictures": False,
    }
    settings: Settings = asked_settings(values, device=run.device, config=None, source_of=lambda key: f"recipe, {key}")
    folder = run.folder(out)
    into: Into = "extend" if is_file(folder / "run.toml") else "own"
    return make_plan(settings, run.settings, folder, into=into)


def execute(run: RecipeRun, plan: Plan, report: Report) -> RunResult:
    """Run the unfinished part of ``plan``; the rows of a sweep are written next to its metrics."""
    result = run_plan(plan, report)
    if run.rows and result.is_complete:
        write_rows(plan.folder.path, run.rows, joins=True)
    return result


@dataclass(frozen=True)
class GivenPredictions:
    """The predictions of one method: their folder, and its encoder's text features if given."""

    place: Path
    text_features: Path | None = None


def named_predictions(
    experiments: Sequence[Experiment], texts: Sequence[str], text_features: Sequence[str] = ()
) -> dict[str, GivenPredictions]:
    """The predictions given by ``METHOD=PREDICTIONS`` and ``METHOD=FILE``, by printed method.

    Raises ``ConfigError`` if no experiment accepts predictions of a method, it is named twice, or a path is missing.
    """
    places = _named(
        "--predictions", "PREDICTIONS", dict.fromkeys(name for one in experiments for name in one.predictions), texts
    )
    features = _named("--text-features", "FILE", places, text_features)
    return {method: GivenPredictions(place, features.get(method)) for method, place in places.items()}


def _named(flag: str, kind: str, known: Mapping[str, object], texts: Sequence[str]) -> dict[str, Path]:
    named: dict[str, Path] = {}
    for text in texts:
        method, equals, path = text.partition("=")
        if not equals or not path:
            raise ConfigError(f"{flag} {printable(text, 80)}: expected METHOD={kind}")
        if method not in known:
            hint = suggest(method, known, "it takes") if known else "; name its --predictions too"
            raise ConfigError(f"{flag}: this recipe takes no '{printable(method, 60)}'{hint}")
        if method in named:
            raise ConfigError(f"{flag}: '{printable(method, 60)}' is given twice; give it once")
        if not Path(path).exists():
            raise ConfigError(f"{flag} {printable(method, 60)}: {printable(path, 200)} does not exist")
        named[method] = Path(path)
    return named


def evaluate_predictions(
    named: Mapping[str, GivenPredictions], experiments: Sequence[Experiment], asked: RecipeRequest, out: Path
) -> list[Path]:
    """Evaluate predictions into one run folder per method and dataset, which stays as it is if nothing changed."""
    folders: list[Path] = []
    for method, given in named.items():
        mine = [one for one in experiments if method in one.predictions]
        addresses = [_by_dataset(one, asked) for one in mine]
        for dataset in dict.fromkeys(chain.from_iterable(addresses)):
            protocols = dict.fromkeys(name for one in mine for name in one.protocols)
            fitting = tuple(name for name in protocols if dataset in load_protocol(name).datasets)
            name = re.sub(r"[^A-Za-z0-9-]+", "-", method).strip("-").lower()
            folder = out / RUNS / f"{dataset}-predictions-{name}"
            # the recipe's scenes: other predicted scenes are in none of its tables
            own = _joined(one.get(dataset, ()) for one in addresses)
            scenes = tuple(dict.fromkeys(scene_names(dataset, own)))
            request = Request(
                (given.place,),
                dataset=dataset,
                protocols=fitting,
                scenes=scenes,
                text_features=given.text_features,
            )
            evaluate_methods({method: request}, folder)
            folders.append(folder)
    return folders
