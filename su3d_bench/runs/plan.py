"""From the request to the plan: one job per scene, everything resolved and checked before any work."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from su3d_bench.core import registry
from su3d_bench.core.config import (
    NEUTRAL_SETTINGS,
    KeyPath,
    RunConfig,
    Setting,
    Settings,
    check_keys,
    check_names,
    flatten,
    parse_value,
    read_assignments,
    read_file,
    resolve,
)
from su3d_bench.core.digests import code_digest, digest_json
from su3d_bench.core.errors import ConfigError, counted, printable, some, suggest
from su3d_bench.core.registry import CEILING_METHOD, GENERATED, MARK
from su3d_bench.core.system.devices import device_for
from su3d_bench.core.types import ImageDomain
from su3d_bench.corruptions.apply import parse_conditions
from su3d_bench.metrics.compatibility import TruthFacts, truth_incompatibility
from su3d_bench.metrics.protocols.loading import (
    ALL_PROTOCOLS,
    headline_protocols,
    load_protocol,
    protocol_names,
    protocols_for,
)
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.perception.language.client import check_key
from su3d_bench.perception.profiles import PROFILES, PerceptionConfig, check_models, default_jobs, resolve_profile
from su3d_bench.runs.executors import SLURM, check_execution
from su3d_bench.runs.existing import (
    ExistingRun,
    Into,
    Request,
    Start,
    check_request,
    differences,
    existing_run,
    extended,
    replaced_jobs,
)
from su3d_bench.runs.job import (
    ConfiguredMethods,
    Part,
    SceneJob,
    check_same_run,
    options_model,
    part_of,
)
from su3d_bench.runs.real_time import check_is_timed, is_measured, with_clock
from su3d_bench.runs.scenes import cache_root, data_root, dataset_targets, expand_scenes, looks_like_scene
from su3d_bench.store.run_folder import JobFolder, RunFolder, scene_of_folder


def asked_settings(
    values: Mapping[str, Any], *, device: str | None, config: Path | None, source_of: Callable[[str], str]
) -> Settings:
    """The settings of the file ``config``, overridden by ``values``; None means not requested.

    ``values`` are by key of a run, ``source_of`` gives the source of a key, with which an error message begins.
    """
    settings = Settings() if config is None else read_file(config)
    given: list[tuple[KeyPath, Any]] = [((name,), value) for name, value in values.items()]
    given.append((("perception", "models", "device"), device))
    return settings + Settings(
        tuple(Setting(path, value, source_of(path[-1])) for path, value in given if value is not None)
    )


MAX_NAMED = 4  # scenes and methods whose maps are removed
MAX_CHARACTERS = 120  # the name is also a folder name
COMMA_OUTSIDE_BRACKETS = re.compile(r",(?![^\[]*\])")


@dataclass(frozen=True)
class NamedMethod:
    """``target`` locates the class, ``base`` is its name, ``name`` the name with the variant.

    A variant is ``METHOD@PRESET`` if the method's class has ``presets`` (``opensu3d@scheme4``), or
    ``METHOD@KEY=VALUE,KEY=VALUE`` with values in TOML (``opensu3d@top_m=1``). It counts as a separate method, and so
    does a method with a ``corruption`` of its inputs (``opensu3d~depth/holes/4``).
    """

    target: str
    base: str
    name: str
    settings: tuple[Setting, ...]
    corruption: str = ""

    @property
    def essence(self) -> tuple[Any, ...]:
        """Its identity, independent of how it was written."""
        return self.target, [(entry.path, entry.value) for entry in self.settings], self.corruption


def named_method(text: str) -> NamedMethod:
    """The method named by ``text``; ``ConfigError`` for an unknown method or preset, or an unreadable variant."""
    start = text.rfind(".py:") + 1
    mark = text.find(MARK, start)
    if mark >= 0:
        clean, corruption = named_method(text[:mark]), text[mark + 1 :]
        name = MARK.join((clean.name, "+".join(one.address for one in parse_conditions(corruption)).replace("/", "-")))
        entries = tuple(replace(one, path=("method", name, *one.path[2:])) for one in clean.settings)
        return NamedMethod(clean.target, clean.base, name, entries, corruption)
    at = text.find("@", start)
    target, variant = (text, "") if at < 0 else (text[:at], text[at + 1 :])
    method = registry.load("method", target)
    base = str(method.name)
    if at < 0:
        return NamedMethod(target, base, base, ())
    name = f"{base}@{variant.replace(' ', '')}"
    if not variant or "/" in variant or not variant.isprintable() or len(name) > MAX_CHARACTERS:
        raise ConfigError(f"--methods {text}: expected METHOD@PRESET or METHOD@KEY=VALUE, such as opensu3d@top_m=1")
    values = _assigned(text, variant) if "=" in variant else _preset(text, base, method, variant)
    entries = tuple(Setting(("method", name, *path), value, f"--methods {text}") for path, value in flatten(values))
    return NamedMethod(target, base, name, entries)


def _preset(text: str, base: str, method: Any, variant: str) -> Mapping[str, Any]:
    presets: Mapping[str, Mapping[str, Any]] = getattr(method, "presets", {})
    if variant not in presets:
        hint = suggest(variant, presets, "it has") or "; it has none"
        raise ConfigError(f"--methods {text}: {base} has no preset '{variant}'{hint}; or write {base}@KEY=VALUE")
    return presets[variant]


def _assigned(text: str, variant: str) -> Mapping[str, Any]:
    values: dict[str, Any] = {}
    for part in COMMA_OUTSIDE_BRACKETS.split(variant):
        key, equals, value = part.partition("=")
        if not equals or not key.strip():
            raise ConfigError(f"--methods {text}: expected KEY=VALUE, not '{part}'")
        values[key.strip()] = parse_value(value)
    return values


@dataclass(frozen=True)
class Plan:
    """What a run will do: one job per scene; ``notes`` are remarks for the user.

    ``existing``: the run in the folder when the plan was made. ``start`` is what happens to it: there is none, or an
    unfinished one, and the records *begin*; it is *kept* until new records overwrite it; or it is *replaced*, and the
    jobs in ``removes`` are removed.
    """

    config: RunConfig
    settings: Settings
    folder: RunFolder
    jobs: tuple[SceneJob, ...]
    n_workers: int
    notes: tuple[str, ...]
    existing: ExistingRun | None = None
    start: Start = "begun"
    removes: tuple[JobFolder, ...] = ()

    @property
    def values(self) -> list[tuple[KeyPath, Any]]:
        """Every resolved value with its path, parts in the order of the run."""
        leaves = flatten(self.config.model_dump(mode="json"))
        job_of_dataset = {job.dataset.name: job for job in self.jobs}
        sections: list[tuple[KeyPath, str]] = [(("method", part.name), part.options) for part in self.jobs[0].methods]
        sections += [(("dataset", name), job.dataset.options) for name, job in job_of_dataset.items()]
        sections.append((("perception",), self.jobs[0].perception))
        for prefix, options in sections:
            leaves += [((*prefix, *path), value) for path, value in flatten(json.loads(options))]
        return leaves

    @property
    def rules(self) -> list[ProtocolRules]:
        """The protocols that score at least one scene."""
        return [load_protocol(name) for name in dict.fromkeys(name for job in self.jobs for name in job.protocols)]

    @property
    def request(self) -> Request:
        protocols = tuple(dict.fromkeys(rules.name for rules in self.rules))
        return Request(tuple(job.scene for job in self.jobs), self.methods, protocols, dict(self.values))

    @property
    def methods(self) -> tuple[str, ...]:
        """Names of the methods that tables show."""
        return tuple(part.name for part in self.jobs[0].methods)

    @property
    def is_partial(self) -> bool:
        return self.config.limit > 0


def make_plan(
    settings: Settings, assignments: Sequence[str] = (), out: Path | None = None, *, into: Into = "own"
) -> Plan:
    """The plan of a request; every error in the request itself is found here, before any work.

    ``assignments`` are ``KEY=VALUE`` texts for ``read_assignments``. ``out`` None: a folder below ``runs/`` named after
    datasets, profile and a key of the request, so that the same command resumes its own run. A folder that
    contains a run of another request is rejected, or extended or replaced, depending on ``into``.
    """
    if into != "own" and out is None:
        raise ConfigError(f"--{into}: name the run with --out, such as --out runs/demo")
    existing = None if out is None else existing_run(out)
    check_keys(settings)
    if into == "extend":
        settings = extended(settings, existing, str(out))
    config = with_clock(resolve(settings, (), RunConfig))
    check_execution(config)
    if config.profile not in PROFILES:
        raise ConfigError(f"unknown profile '{config.profile}'{suggest(config.profile, PROFILES)}")
    named_methods = [named_method(text) for text in method_targets(config.methods)]
    _check_unique_names("--methods", [(method.name, method.essence) for method in named_methods])
    named = {method.name: method for method in named_methods}
    named_datasets = [(str(registry.load("dataset", target).name), target) for target in dataset_targets(config.scenes)]
    _check_unique_names("--scenes", named_datasets)
    targets = dict(named_datasets)
    settings += read_assignments(assignments, [*{method.base for method in named_methods}, *named], list(targets))
    _check_sections("method", settings, {method.base: method.target for method in named_methods}, list(named))
    _check_sections("dataset", settings, targets)
    of_perception = resolve(settings, ("perception",), PerceptionConfig)
    check_models(config.profile, of_perception)
    if config.executor != SLURM:
        device_for(of_perception.models.device, 0)  # raises if there is no such GPU
    perception = of_perception.model_dump_json()
    methods = tuple(method_part(method, settings) for method in named_methods)
    ceiling = None if CEILING_METHOD in named else part_of("method", CEILING_METHOD, settings)
    datasets = {target: part_of("dataset", target, settings) for target in targets.values()}
    protocols = protocols_of_run(config.protocols, list(datasets))
    asked = asks_language_model(config.model_dump())
    rules = [load_protocol(name) for names in protocols.values() for name in names]
    for name in asked:
        if not any(map(USES_LANGUAGE[name], rules)):
            raise ConfigError(f"{flag_of(name)}: needs a reasoning protocol, such as --protocols homes-reasoning")
    if out is None:
        out = Path("runs") / _run_name(config, methods, tuple(datasets.values()), perception)
        existing = existing_run(out)
    folder = RunFolder(out)
    folder.check_is_run_folder()
    domain: ImageDomain = "rendered-rooms" if set(targets) <= GENERATED else "camera"
    profile = resolve_profile(config.profile, domain, of_perception)
    uses_captions = profile == "paper" and of_perception.paper.captions == "model"
    check_is_timed(config, profile, uses_captions=uses_captions)
    has_replies = config.offline or (folder.path / "language").is_dir()  # else requests are sent
    if (asked or uses_captions) and not has_replies and config.executor != SLURM:
        check_key(of_perception.language)
    chosen, notes = expand_scenes(config.scenes, datasets)
    jobs = tuple(
        SceneJob(
            scene=f"{datasets[target].name}/{scene}",
            dataset=datasets[target],
            methods=methods,
            ceiling=ceiling if protocols[target] else None,
            protocols=protocols[target],
            config=config,
            perception=perception,
            folder=folder.path,
            data_root=data_root(),
            cache_root=cache_root(),
            index=index,
            replaces=into == "replace",
        )
        for index, (target, scene) in enumerate(chosen)
    )
    n_alone = 1 if is_measured(config) and config.executor != SLURM else 0  # parallel jobs slow each other
    n_here = config.jobs or n_alone or (len(jobs) if config.executor == SLURM else default_jobs(profile, of_perception))
    n_workers = min(n_here, len(jobs))
    notes += tuple(_notes_on_protocols(protocols, config.protocols))
    return _started(Plan(config, settings, folder, jobs, n_workers, notes, existing), into)


def _started(plan: Plan, into: Into) -> Plan:
    """``plan`` with what happens to the run in its folder; a ``StoreError`` if that is a different one."""
    existing = plan.existing
    if existing is not None:
        check_request(existing, plan.request, into, str(plan.folder.path))
    methods = ConfiguredMethods()
    for job in plan.jobs:
        for part in job.methods:
            folder = plan.folder.job(job.scene, part.name)
            folder.check_no_links()
            if into != "replace":
                check_same_run(folder, methods.of(job, part)[1], is_early=True)
    if into == "replace":
        removes = tuple(replaced_jobs(plan.folder, plan.jobs))
        if removes or (existing is not None and any(differences(existing, plan.request))):
            return replace(plan, start="replaced", removes=removes, notes=(*plan.notes, *_removed_lines(plan, removes)))
        # otherwise the run that replaced another is resumed
    return replace(plan, start="begun" if existing is None or not existing.is_finished else "kept")


def _removed_lines(plan: Plan, removes: Sequence[JobFolder]) -> list[str]:
    if not removes:
        return []
    going = [job.path.parts[-2:] for job in removes]
    scenes, methods = (list(dict.fromkeys(names)) for names in zip(*going, strict=True))
    which = f"{some([scene_of_folder(name) for name in scenes], MAX_NAMED)} by {some(methods, MAX_NAMED)}"
    n_all = len(plan.folder.jobs())
    return [f"--replace: {len(removes)} of the {counted(n_all, 'map')} in {plan.folder.path} will be removed: {which}"]


def _check_unique_names(flag: str, named: Iterable[tuple[str, Any]]) -> None:
    """A ``ConfigError`` if a name is not valid as a folder name, or two different things share one."""
    found: dict[str, Any] = {}
    for name, value in named:
        check_folder_name(flag, name)
        if found.setdefault(name, value) != value:
            raise ConfigError(f"{flag}: two different ones are named '{name}'; rename one of them")


def check_folder_name(flag: str, name: str) -> None:
    """A ``ConfigError`` if ``name``, given by ``flag``, is not valid as a folder name."""
    is_plain = name.isprintable() and "/" not in name and len(name) <= MAX_CHARACTERS
    if not name or name.startswith(".") or not is_plain:
        raise ConfigError(f"{flag}: '{printable(name, 80)}' is not a valid folder name; use letters and digits")


def method_part(method: NamedMethod, settings: Settings) -> Part:
    """A method with the settings of its base, then those of its variant, then those under its own full name."""
    path = "method", method.name
    base, own = (
        [replace(entry, path=(*path, *entry.path)) for entry in settings.under(("method", name))]
        for name in (method.base, method.name)
    )
    layered = Settings((*base, *method.settings, *(own if method.name != method.base else ())))
    options = resolve(layered, path, options_model("method", method.target))
    return Part(method.target, method.name, options.model_dump_json(), method.corruption)


def _check_sections(kind: str, settings: Settings, used: Mapping[str, str], variants: Sequence[str] = ()) -> None:
    """Reject sections of unknown names; a shared file may configure parts unused here, but its keys must exist.

    ``used``: name -> target; ``variants`` are full names with their own sections, checked with their part.
    """
    known = dict.fromkeys([*used, *registry.names(kind)])
    check_names(kind, settings, [*known, *variants])
    for name in known:
        if settings.under((kind, name)):
            resolve(settings, (kind, name), options_model(kind, used.get(name, name)))


def _all_systems() -> list[str]:
    loaded = {name: registry.load("method", name) for name in registry.METHODS}
    return [name for name, method in loaded.items() if getattr(method, "is_system", True)]


def method_targets(methods: Sequence[str]) -> list[str]:
    """The requested methods once each, ``all`` replaced by the names of all systems; ``ConfigError`` for a scene."""
    named = [name for method in methods for name in (_all_systems() if method == "all" else [method])]
    targets = list(dict.fromkeys(named))
    for target in targets:
        clean = target.rpartition(MARK)[0] or target
        if clean not in registry.names("method") and looks_like_scene(clean):
            raise ConfigError(f"--methods {target}: is a scene; write it before the flags or after --scenes")
    if not targets:
        raise ConfigError("no method named; known: " + ", ".join(registry.names("method")))
    return targets


def protocols_of_run(wanted: Sequence[str], targets: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Dataset target -> protocols that score it: the requested ones that fit it, by default its headline protocol.

    ``ALL_PROTOCOLS`` requests those of ``usual_protocols``.
    """
    usual = {target: usual_protocols(target) for target in targets}
    if not wanted:
        return {target: headline_protocols(registry.load("dataset", target)) or usual[target] for target in targets}
    are_all = ALL_PROTOCOLS in wanted
    wanted = [name for name in dict.fromkeys(wanted) if name != ALL_PROTOCOLS]
    rules = [load_protocol(name) for name in wanted]
    _check_unique_names("--protocols", [(rule.name, rule) for rule in rules])
    truths = {target: TruthFacts.of_dataset(registry.load("dataset", target)) for target in targets}
    for rule in rules:
        reasons = [reason for truth in truths.values() if (reason := truth_incompatibility(rule, truth)) is not None]
        if len(reasons) == len(truths):
            raise ConfigError(f"protocol '{rule.name}' fits no scene of this run: {reasons[0]}")
    return {
        target: tuple(dict.fromkeys([
            *(usual[target] if are_all else ()),
            *(name for name, one in zip(wanted, rules, strict=True) if not truth_incompatibility(one, truth)),
        ]))
        for target, truth in truths.items()
    }  # fmt: skip


def usual_protocols(target: str) -> tuple[str, ...]:
    """The protocols of a dataset, its headline first; if no protocol names it, those that fit its ground truth."""
    dataset = registry.load("dataset", target)
    own = protocols_for(dataset.name)
    if not own and dataset.variants:
        truth = TruthFacts.of_dataset(dataset)
        known = (rules for rules in map(load_protocol, protocol_names()) if rules.by_default)
        own = [rules.name for rules in known if truth_incompatibility(rules, truth) is None]
    return tuple(dict.fromkeys([*headline_protocols(dataset), *own]))


def _notes_on_protocols(protocols: Mapping[str, Sequence[str]], wanted: Sequence[str]) -> Iterator[str]:
    """Notes on which protocols score user-defined datasets, if none was requested."""
    for target, names in protocols.items():
        dataset = registry.load("dataset", target)
        if wanted or not dataset.variants or protocols_for(dataset.name) or headline_protocols(dataset):
            continue
        if names:
            yield f"{dataset.name}: scored under all protocols that fit its ground truth; choose with --protocols"
            continue
        truth = f"ground truth {', '.join(dataset.variants)} with labels of '{dataset.label_space}'"
        yield f"{dataset.name}: no protocol fits its {truth}; create a custom one: su3d-bench protocols new FILE"


# Settings of a run that ask a language model, with the value that does, and the protocols that they affect.
ASKS = {"question_solver": "llm", "refiner": "model"}
USES_LANGUAGE: Mapping[str, Callable[[ProtocolRules], bool]] = {
    "question_solver": lambda rules: rules.answers is not None,
    "refiner": lambda rules: rules.uses_names,
}


def flag_of(name: str) -> str:
    """The option that asks a language model."""
    return f"--{name.replace('_', '-')} {ASKS[name]}"


def asks_language_model(values: Mapping[str, Any]) -> list[str]:
    """The settings among ``values`` that ask a language model."""
    return [name for name, value in ASKS.items() if values.get(name) == value]


def _run_name(config: RunConfig, methods: Sequence[Part], datasets: Sequence[Part], perception: str) -> str:
    request = config.model_dump(mode="json", exclude=set(NEUTRAL_SETTINGS))
    options = [part.options for part in (*methods, *datasets)]
    own = [digest for part in (*methods, *datasets) if (digest := registry.code_key(part.target))]
    key = digest_json([request, options, perception, code_digest(), *own])[:8]
    return "-".join([*(part.name for part in datasets), config.profile, key])
