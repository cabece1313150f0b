"""What a run did differently from OpenSU3D's paper, from ``deviations.toml`` and the records of the run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from su3d_bench.analysis.sweeps import without_cells
from su3d_bench.core.config import flatten, toml_value
from su3d_bench.core.errors import Su3dError, printable
from su3d_bench.core.files.atomic import read_json
from su3d_bench.core.registry import base_name
from su3d_bench.core.system.files import file_text, parse_toml
from su3d_bench.formats.tables.table import Table, text_table
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.questions.score import ANSWERED_BY, REFINED_BY, remarks_starting
from su3d_bench.opensu3d.config import OpenSU3DConfig
from su3d_bench.perception.language.captioner import REFINE_FORM
from su3d_bench.perception.language.chat import PRESETS
from su3d_bench.perception.models.catalogue import MODELS
from su3d_bench.perception.models.config import PaperConfig
from su3d_bench.perception.models.masks.grounded_sam import WORDS_CAVEAT
from su3d_bench.perception.paper import PAPER_ENCODER
from su3d_bench.reports.tables.paper import PAPER_PROFILE, PAPER_SCENES
from su3d_bench.runs.finished import FinishedRun
from su3d_bench.runs.job import GENERATED_SCENES
from su3d_bench.runs.plan import named_method

METHOD = "opensu3d"
STRIDE, BORDER_PX, VOXEL_M, AP_END, PROMPT = 40, 20, 0.0025, 0.95, "an {} in a scene"  # the paper's
COLOUR_SIZES = {"replica": (1200, 680), "scannet": (1296, 968)}  # width, height
PAPER_MODELS = PRESETS["paper"]
NAMED_BY = {"paper": "the tagger", "embedded": "the encoder", "oracle": "the ground truth", "stored": "the detections"}
TABLE: Sequence[Mapping[str, Any]] = parse_toml(file_text(Path(__file__).with_name("deviations.toml")))["deviation"]
DEFAULTS = {
    f"{prefix}{'.'.join(path)}": value
    for prefix, config in (("method.", OpenSU3DConfig()), ("perception.paper.", PaperConfig()))
    for path, value in flatten(config.model_dump(mode="json"))
}
# Settings without a row of their own that another row covers.
COVERED = {"method.stride", "method.border_px", "method.border_reference_width"} | {
    f"perception.paper.{name}" for name in ("captions", "tagger")
}


@dataclass(frozen=True)
class Facts:
    """What the records of a run say about one variant of OpenSU3D.

    ``settings`` by dotted key, those of the method below ``method``; ``varied``: the ones that the variant's name sets,
    as in the paper's ablation. ``protocols`` have scores; ``remarks`` are on these. ``sizes``: width and height of the
    images, by dataset; ``dropped``: parameters that the language model did not accept.
    """

    settings: Mapping[str, Any]
    profile: str
    encoder: str | None
    scenes: tuple[str, ...]
    varied: frozenset[str] = frozenset()
    caveat: str = ""
    protocols: tuple[ProtocolRules, ...] = ()
    remarks: tuple[str, ...] = ()
    sizes: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    dropped: frozenset[str] = frozenset()

    def get(self, key: str) -> Any:
        value = self.settings.get(key, DEFAULTS.get(key))
        return list(value) if isinstance(value, tuple) else value

    def counts(self, key: str) -> bool:
        """Whether the run used the setting and the paper's ablation does not vary it."""
        is_used = self.profile == PAPER_PROFILE or not key.startswith("perception.paper.")
        return is_used and key not in self.varied

    def grouped(self, text: Callable[[ProtocolRules], str]) -> list[str]:
        """One line with the protocols to which ``text`` applies, for each different text; '' applies to none."""
        lines = {line: [one.name for one in self.protocols if text(one) == line] for line in map(text, self.protocols)}
        return [f"{line} ({', '.join(names)})" for line, names in lines.items() if line]


@dataclass(frozen=True)
class Deviation:
    """One difference: what the paper states in a ``section``, what was done ``here``, and the option to ``match``."""

    name: str
    section: str
    paper: str
    here: str
    match: str = ""
    runs: tuple[str, ...] = ()


def deviations(facts: Facts) -> Iterator[Deviation]:
    """The differences from the paper, in the order of ``deviations.toml``."""
    found = _found(facts)
    for row in TABLE:
        here, key = found.get(row["name"], ()), row.get("setting")
        if key and facts.counts(key):
            value = facts.get(key)
            is_same = value >= row["at_least"] if "at_least" in row else value == row["equals"]
            here = () if is_same else (row["here"].format(toml_value(value) if value is not None else ""),)
        yield from (Deviation(row["name"], row["section"], row["paper"], one, row.get("match", "")) for one in here)


def _found(facts: Facts) -> dict[str, Iterable[str]]:
    """What was done differently, by the name of the row without a setting of its own."""
    get, is_paper = facts.get, facts.profile == PAPER_PROFILE
    refined_by, answered_by = (remarks_starting(facts.remarks, start) for start in (REFINED_BY, ANSWERED_BY))
    has_captions = is_paper and get("perception.paper.captions") == "model"
    vision, temperature = get("perception.language.vision_model"), get("perception.language.temperature")
    prompts = {
        "captions: the reply is requested as JSON too": has_captions,
        f"label n': followed by '{REFINE_FORM}'": any("the model " in one for one in refined_by),
        "reasoning: with the form of list and answer": any("language model " in one for one in answered_by),
    }
    of_paper = {f"{name}/{scene}" for name, scenes in PAPER_SCENES.items() for scene in scenes}
    n_same = len(of_paper & set(facts.scenes))
    n_paper = sum(scene.partition("/")[0] in {one.partition("/")[0] for one in facts.scenes} for scene in of_paper)
    scenes = f"{n_same} of the paper's {n_paper or len(of_paper)}, {len(facts.scenes) - n_same} others"
    rings = {name: get(f"method.{name}") for name in ("border_px", "border_reference_width")}
    borders = {name: (OpenSU3DConfig(**rings).border_in(width), width) for name, (width, _) in facts.sizes.items()}
    captioned = [vision] if vision != PAPER_MODELS["vision_model"] else []
    stride = get("stride") or get("method.stride")
    encoders = {MODELS[PAPER_ENCODER].known_as, *(rules.encoder for rules in facts.protocols)}
    names = {rules.name for rules in facts.protocols}
    covered = {row.get("setting") for row in TABLE} | COVERED
    others = (key for key, usual in DEFAULTS.items() if key not in covered and facts.counts(key) and get(key) != usual)
    is_complete = n_same == n_paper == len(facts.scenes)
    template = "" if facts.profile == "stored" else ", captions by a template"
    has_mesh = "replica-mesh-ex6" in names and "replica-conceptgraphs-ex6" not in names
    return {
        "scenes": _if(not is_complete, "procedurally generated scenes" if GENERATED_SCENES in facts.caveat else scenes),
        "stride": _if(stride != STRIDE, str(stride)),
        "image size": [
            f"{size[0]}x{size[1]} ({name})"
            for name, size in facts.sizes.items()
            if COLOUR_SIZES.get(name, size) != size
        ],
        "masks": _if(not is_paper, f"those of the profile '{facts.profile}'"),
        "tagger": _if(WORDS_CAVEAT in facts.caveat, "the most likely words of a list, by the encoder"),
        "encoder": _if(facts.encoder not in {None, *encoders}, printable(str(facts.encoder), 100)),
        "names and captions": captioned if has_captions else [f"names by {NAMED_BY[facts.profile]}{template}"],
        "prompts of language models": [line for line, is_used in prompts.items() if is_used],
        "temperature": _if(any(prompts.values()) and temperature not in (0, None), str(temperature))
        + _if("temperature" in facts.dropped, "not accepted by the model"),
        "border": [
            f"{px} px in images {width} px wide ({name})" for name, (px, width) in borders.items() if px != BORDER_PX
        ],
        "label n'": _others(refined_by),
        "filter of labels n'": _if(bool(refined_by), "boxes over 95 % of the map from above"),
        "reasoning": _others(answered_by),
        "judges": facts.grouped(lambda rules: "the ground truth" if rules.is_judged else ""),
        "questions": facts.grouped(lambda rules: "generated" if rules.questions == "generated" else ""),
        "prompt of classes": facts.grouped(_prompt),
        "voxels of evaluation": facts.grouped(_voxels),
        "thresholds of AP": facts.grouped(_thresholds),
        "evaluated points": _if(has_mesh, "vertices of the annotated mesh"),
        "other settings": [f"{key.removeprefix('method.')} = {toml_value(get(key))}" for key in others],
    }


def _if(is_so: bool, line: str) -> list[str]:
    return [line] if is_so else []


def _prompt(rules: ProtocolRules) -> str:
    return "" if rules.vocabulary is None or rules.prompt == PROMPT else f"'{rules.prompt or rules.prompts[0]}'"


def _thresholds(rules: ProtocolRules) -> str:
    end = max(rules.thresholds, default=AP_END)
    return "" if end >= AP_END else f"0.5 to {end:.3g}"


def _others(sources: Iterable[str]) -> list[str]:
    return [printable(one, 200) for one in sources if f"model {PAPER_MODELS['text_model']}" not in one]


def _voxels(rules: ProtocolRules) -> str:
    voxel_m = rules.transfer.evaluation_voxel_m
    return "" if rules.vocabulary is None or voxel_m == VOXEL_M else f"{voxel_m:g} m" if voxel_m else "none"


def facts_of(run: FinishedRun, method: str) -> Facts:
    """The facts of one variant of OpenSU3D in a finished run; images of a dataset that is not here are not checked."""
    own = ("method", method)
    of_run = {path: value for path, value in run.settings.items() if path[0] != "method" or path[:2] == own}
    results = [one for (name, _), one in run.results.items() if name == method]
    sizes: dict[str, tuple[int, int]] = {}
    for scene in run.scenes:
        dataset, _, name = scene.partition("/")
        with suppress(Su3dError, IndexError):
            if dataset not in sizes:
                height, width = run.dataset(scene).frames(name, 1)[0].rgb.shape[:2]
                sizes[dataset] = width, height
    replies = map(read_json, (run.folder.path / "language").glob("*.json"))
    return Facts(
        settings={".".join((path[0], *path[1 + (path[0] == "method") :])): value for path, value in of_run.items()},
        profile=next((one.profile for one in results if one.profile), "embedded"),
        encoder=run.record.encoder,
        scenes=run.scenes,
        varied=frozenset(".".join(("method", *entry.path[2:])) for entry in named_method(method).settings),
        caveat="; ".join({one.caveat: None for one in results if one.caveat}),
        protocols=tuple(run.rules(one.protocol) for one in results if one.result),
        remarks=tuple({line: None for one in results if one.result for line in one.result.warnings}),
        sizes=sizes,
        dropped=frozenset(name for reply in replies for name in reply.get("reply", {}).get("dropped", ())),
    )


def run_deviations(runs: Iterable[FinishedRun]) -> list[Deviation]:
    """The differences of all runs of OpenSU3D, each once with the names of its runs."""
    found: dict[tuple[str, str], Deviation] = {}
    for run in runs:
        clean = without_cells(run).methods
        for method in (name for name in clean if base_name(name) == "opensu3d" and name not in run.external):
            for one in deviations(facts_of(run, method)):
                known = found.setdefault((one.name, one.here), one)
                names = tuple(dict.fromkeys((*known.runs, run.folder.path.name)))
                found[one.name, one.here] = replace(known, runs=names)
    order = [row["name"] for row in TABLE]
    return sorted(found.values(), key=lambda one: order.index(one.name))


def deviation_table(found: Sequence[Deviation]) -> Table:
    """The differences from the paper, one per row."""
    rows = [["what", "paper", "here", "section of the paper", "as in the paper with"]]
    rows += [[one.name, one.paper, one.here, one.section, one.match or "-"] for one in found]
    caption = ": what OpenSU3D did differently from its paper in these runs."
    return text_table("deviations", rows, heading="Differences from the paper", caption=caption)
