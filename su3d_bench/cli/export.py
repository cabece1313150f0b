"""``su3d-bench runs export``: write predictions in the formats of other evaluators."""

from __future__ import annotations

import argparse
import fnmatch
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from su3d_bench.cli.options import Verbs, add_verb, output_path
from su3d_bench.cli.output import answer, answer_json, remark
from su3d_bench.core.errors import ConfigError, PredictionError, counted, printable, suggest

if TYPE_CHECKING:
    from su3d_bench.core.config import RunConfig
    from su3d_bench.core.interfaces import Encoder
    from su3d_bench.metrics.protocols.model import ProtocolRules
    from su3d_bench.predictions.base import Content, Reader

TARGETS = ("openlex3d", "scannet", "scannetpp", "opensun3d")
QUERY_RULES = "opensun3d-queries"


def add_parser(verbs: Verbs) -> None:
    parser = add_verb(verbs, "export", call, data=True)
    parser.option("path RUN_OR_PREDICTION", "run folder, or files of predictions", type=Path)
    parser.option("--to", "format to write (of these evaluators)", required=True, choices=TARGETS)
    parser.option("--out DIR", "new folder for the files", type=output_path, required=True)
    parser.option("--method METHOD", "method to use (default: the only one besides the oracle)")
    parser.shared("--scenes")
    parser.option("--input-format FORMAT", "format of the predictions (default: detected)")
    parser.option(
        "--protocol PROTOCOL", "protocol to use (for the classes of scannet and scannetpp; default: the only one)"
    )
    parser.shared("--text-features")


@dataclass(frozen=True)
class Source:
    """One scene's prediction: its reader, path and scene address. ``run`` is its run folder, if any."""

    reader: Reader
    path: Path
    scene: str
    address: str
    run: Path | None = None


def call(arguments: argparse.Namespace) -> None:
    """Export predictions in the format of another evaluator.

    su3d-bench runs export runs/my-run --to openlex3d --method opensu3d --out exported/opensu3d
    su3d-bench runs export results/open3dis --to scannet --scenes 'replica/*' --out exported/open3dis
    """
    from su3d_bench.predictions.export import whole_folder, write_openlex

    is_openlex = arguments.to == "openlex3d"
    for flag, value, users in (
        ("--protocol", arguments.protocol, TARGETS[1:3]),
        ("--text-features", arguments.text_features, TARGETS[1:]),
    ):
        if value is not None and arguments.to not in users:
            raise ConfigError(f"{flag} {value}: only valid with --to {' or '.join(users)}; leave it out")
    sources = chosen(
        sources_of(arguments.path, arguments.input_format, arguments.method), arguments.scenes, arguments.path
    )
    names = _names([source.address for source in sources], is_flat=not is_openlex)
    rows = []
    with whole_folder(arguments.out) as folder:
        for source, name in zip(sources, names, strict=True):
            prediction = source.reader.read(source.path, source.scene)
            try:
                if is_openlex:
                    remarks = write_openlex(prediction.content, folder / name)
                elif arguments.to == "opensun3d":
                    remarks = _write_answer(prediction.content, source, arguments, name, folder)
                else:
                    remarks = _write_for_classes(prediction.content, source, arguments, name, folder)
            except PredictionError as error:
                raise PredictionError(f"{printable(source.address, 120)}: {error}") from error
            remarks = (*_partial_remark(source.run), *prediction.remarks, *remarks)
            rows.append({"scene": source.address, "remarks": list(remarks)})
    if answer_json(arguments, {"to": arguments.to, "folder": str(arguments.out), "scenes": rows}):
        return
    for row in rows:
        for line in row["remarks"]:
            remark(printable(f"{row['scene']}: {line}"), quiet=arguments.quiet)
    answer(f"{counted(len(rows), 'scene')} for {arguments.to}: {arguments.out}")


def _partial_remark(run: Path | None) -> tuple[str, ...]:
    """A warning if the run was limited to the first frames."""
    limit = 0 if run is None else _config_of(run).limit
    return (f"partial: the map uses only the first {limit} updates",) if limit else ()


def _config_of(run: Path) -> RunConfig:
    from su3d_bench.core.config import RunConfig, read_file, resolve

    return resolve(read_file(run / "run.toml"), (), RunConfig)


def sources_of(path: Path, format: str | None, method: str | None) -> list[Source]:
    """All scenes at ``path``: of one method of a run folder, or found by the reader of its format."""
    from su3d_bench.core.registry import CEILING_METHOD
    from su3d_bench.predictions.formats import recognise
    from su3d_bench.predictions.run_predictions import OWN_RUNS, of_method

    files = sorted(path.glob("scenes/*/*/prediction.npz")) if format in {None, OWN_RUNS.name} else []
    methods = list(dict.fromkeys(file.parent.name for file in files))
    if method is not None and method not in methods:
        if not methods:
            raise ConfigError(f"--method {method}: only valid for a run folder, {path} is not one")
        raise ConfigError(f"{path}: no map of method '{method}'{suggest(method, methods, 'it has')}")
    named = [name for name in methods if name != CEILING_METHOD] or methods
    if method is None and len(named) > 1:
        raise ConfigError(f"{path}: has maps of {', '.join(named)}; choose one with --method")
    reader = of_method(recognise(path, format), method or next(iter(named), None))
    scenes = reader.scenes(path)
    if not scenes:
        raise PredictionError(f"{printable(str(path), 300)}: no prediction in format '{reader.name}'")
    return [Source(reader, file if methods else path, name, name, _run_of(file)) for name, file in scenes.items()]


def _run_of(file: Path) -> Path | None:
    """The run folder of a map."""
    above = file.absolute().parents
    is_in_run = file.name == "prediction.npz" and len(above) > 3 and (above[3] / "run.toml").is_file()
    return above[3] if is_in_run else None


def chosen(sources: Sequence[Source], patterns: Sequence[str], path: Path) -> list[Source]:
    """The sources that match a pattern, or all; a scene without a dataset takes that of the pattern."""
    from su3d_bench.runs.scenes import split_address

    if not patterns:
        return list(sources)
    matches: dict[str, Source] = {}
    for pattern in patterns:
        dataset, tail = split_address(pattern)
        matching = []
        for source in sources:
            lacks_dataset = bool(tail) and "/" not in source.scene
            if fnmatch.fnmatchcase(source.scene, tail if lacks_dataset else pattern):
                matching.append(replace(source, address=f"{dataset}/{source.scene}") if lacks_dataset else source)
        if not matching:
            hint = suggest(pattern, [source.scene for source in sources], "it has")
            raise ConfigError(printable(f"{path}: no scene matches '{pattern}'{hint}"))
        matches.update({source.address: source for source in matching})
    return list(matches.values())


def _names(addresses: Sequence[str], *, is_flat: bool) -> list[str]:
    """The file name of each scene: its address, or its last part in a flat folder, where it must be unique."""
    from su3d_bench.predictions.export import file_name
    from su3d_bench.runs.scenes import split_address

    names = []
    for address in addresses:
        dataset, scene = split_address(address)
        parts = [dataset.rpartition(":")[2], scene] if scene else [dataset]
        names.append("/".join(file_name(part) for part in (parts[-1:] if is_flat else parts)))
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ConfigError(f"two scenes are named '{twice}'; choose one with --scenes")
    return names


def _write_for_classes(
    content: Content, source: Source, arguments: argparse.Namespace, name: str, folder: Path
) -> tuple[str, ...]:
    """The files of a scene in a format with classes on the ground-truth points."""
    from su3d_bench.predictions import export
    from su3d_bench.predictions.base import VertexMasks

    is_scannetpp = arguments.to == "scannetpp"

    def write(masks: Any, rules: ProtocolRules | None) -> tuple[str, ...]:
        if is_scannetpp:
            return export.write_scannetpp(masks, rules, name, folder)
        return export.write_scannet(masks, name, folder)

    if isinstance(content, VertexMasks) and not export.needs_truth(content, "line" if is_scannetpp else "id"):
        masks = export.masks_as_they_are(content)
        return write(masks, None)
    dataset, scene = _scene_of(source, "replica", is_quiet=arguments.quiet)
    rules = _rules(arguments.protocol, dataset, source.run, is_ranked=is_scannetpp)
    encoder = _encoder(content, source, rules, arguments.text_features)
    truth = dataset.ground_truth(scene, rules.ground_truth)
    if not rules.names_masks:
        return export.write_scannetpp_labels(content, rules, truth, encoder, name, folder)
    masks = export.masks_on_truth(content, rules, truth, encoder)
    return write(masks, rules)


def _write_answer(
    content: Content, source: Source, arguments: argparse.Namespace, name: str, folder: Path
) -> tuple[str, ...]:
    """The masks that answer the query of a scene: as predicted, or by querying its map."""
    from su3d_bench.core.interfaces import HasSceneQuery, HasSurface
    from su3d_bench.metrics.protocols.loading import load_protocol
    from su3d_bench.predictions import export
    from su3d_bench.predictions.base import VertexMasks

    if isinstance(content, VertexMasks) and export.is_answer(content):
        return export.write_opensun3d(export.masks_as_predicted(content), name, folder)
    dataset, scene = _scene_of(source, "arkitscenes", is_quiet=arguments.quiet)
    if not isinstance(dataset, HasSceneQuery) or not isinstance(dataset, HasSurface):
        raise PredictionError("the dataset has no queries; --to opensun3d needs scenes of arkitscenes")
    rules = load_protocol(QUERY_RULES)
    encoder = _encoder(content, source, rules, arguments.text_features)
    asked = dataset.asked_text(scene)
    vertices = dataset.surface(scene).vertices
    return export.write_opensun3d(export.answer_to(asked, content, rules, vertices, encoder), name, folder)


def _scene_of(source: Source, usual: str, *, is_quiet: bool) -> tuple[Any, str]:
    """The dataset and the scene of a prediction, with the settings of its run."""
    from su3d_bench.cli.scenes import chosen_scenes
    from su3d_bench.runs.finished import data_of_map

    if "/" not in source.address:
        raise PredictionError(f"dataset unknown; name it, such as --scenes {usual}/{source.scene}")
    if source.run is None:
        return chosen_scenes([source.address], [], is_quiet=is_quiet)[0]
    data = data_of_map(source.run, source.address, source.path)
    return data.dataset(source.address), source.address.partition("/")[2]


def _rules(name: str | None, dataset: Any, run: Path | None, *, is_ranked: bool) -> ProtocolRules:
    """The protocol ``name``, or the dataset's only instance protocol with classes.

    Protocols of kind top-k fit only ranked classes (``is_ranked``).
    """
    from su3d_bench.metrics.compatibility import TruthFacts, truth_incompatibility
    from su3d_bench.metrics.protocols.loading import load_protocol, protocol_names, protocols_for
    from su3d_bench.runs.finished import read_run

    def has_masks(rules: ProtocolRules) -> bool:
        return rules.names_masks and rules.confidence is not None

    fitting = {rules.name: rules for rules in map(load_protocol, protocols_for(dataset.name)) if has_masks(rules)}
    if name is None:
        if len({(rules.ground_truth, rules.classes) for rules in fitting.values()}) != 1:
            known = ", ".join(fitting) or "none fits"
            raise ConfigError(f"{dataset.name}: no default protocol; choose one with --protocol ({known})")
        return next(iter(fitting.values()))
    is_own = run is not None and not name.endswith(".toml") and name not in protocol_names()
    finished = read_run(run) if run is not None and is_own else None
    rules = finished.rules(name) if finished is not None and name in finished.protocols else load_protocol(name)
    reason = truth_incompatibility(rules, TruthFacts.of_dataset(dataset))
    if reason is not None or not (has_masks(rules) or (is_ranked and rules.kind == "top-k")):
        raise ConfigError(f"--protocol {name}: {reason or 'no instance classes'}")
    return rules


def _encoder(content: Content, source: Source, rules: ProtocolRules, texts: Path | None) -> Encoder | None:
    """The encoder for the features; None if the prediction has classes or no features."""
    from su3d_bench.evaluation.scoring import facts_of
    from su3d_bench.evaluation.texts import encoder_for, read_text_features
    from su3d_bench.metrics.compatibility import n_feature_dimensions
    from su3d_bench.runs.finished import encoder_of
    from su3d_bench.store.run_folder import RunFolder

    n_dimensions = n_feature_dimensions(rules, facts_of(content))
    if n_dimensions is None:
        return None
    if source.run is not None and texts is None:
        return encoder_of(RunFolder(source.run))
    is_own = source.reader.name == "su3d-bench"
    encoder = encoder_for(rules, n_dimensions, read_text_features(texts), is_own=is_own)
    if isinstance(encoder, str):
        raise PredictionError(f"{rules.name}: {encoder}")
    return encoder
