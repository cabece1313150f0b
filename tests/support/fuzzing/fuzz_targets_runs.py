"""What reads run folders, references, sheets, papers, configurations, caches and the words of language models."""

from __future__ import annotations

import atexit
import functools
import io
import itertools
import json
import shutil
import tempfile
import zipfile
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from cli_calls import called
from fuzzing import Make, Read, Target, every_one_of
from places import SCENES

COLLECTOR = f"{SCENES}/painted.py:Collector"


@functools.cache
def _made_run() -> Path:
    """A folder with a finished run of two painted scenes, with maps midway; made once a process."""
    import pytest
    from painted import colour_perception

    from su3d_bench.runs import scene as scene_run

    folder = Path(tempfile.mkdtemp(prefix="fuzzrun")).resolve()
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene_run, "build_perception", colour_perception)
        patch.setenv("SU3D_DATA", str(folder / "data"))
        called(_command(folder / "a"))
    return folder / "a"


def _command(out: Path) -> list[str]:
    painted = f"{SCENES}/painted.py:Painted"
    words = ["run", "--scenes", f"{painted}/a", f"{painted}/b", "--methods", COLLECTOR]
    words += [f"{COLLECTOR}@drop=1", "--protocols", "rooms-semantic", "rooms-instance", "--no-pictures", "--jobs", "1"]
    return [*words, "--anytime", "0.5", "--out", str(out), "--quiet"]


def copied_run(folder: Path) -> Path:
    shutil.copytree(_made_run(), folder / "runs/a")
    return folder / "runs/a"


def _checked_counts(side: Any, protocol: str) -> None:
    from su3d_bench.analysis.sides import check_shapes

    check_shapes(side.run.rules(protocol), side, side.run.scores(side.method).get(protocol, {}))


def _run(folder: Path) -> Read:
    """Everything that is read of a finished run."""
    from su3d_bench.analysis.gate.check import check
    from su3d_bench.analysis.gate.reference import learn, read_reference
    from su3d_bench.analysis.leaderboard import leaderboard
    from su3d_bench.analysis.sides import Side
    from su3d_bench.analysis.tables import measured_results
    from su3d_bench.runs.advice import recent_update_s
    from su3d_bench.runs.finished import read_run, read_update_times

    path, reference = copied_run(folder), folder / "reference.json"
    reference.write_text(json.dumps(learn([read_run(path)]).model_dump(mode="json")))
    is_scored_again = itertools.cycle([True, False, False, False])  # the leaderboard draws intervals, which is slow

    def asked() -> Iterator[Read]:
        yield lambda: recent_update_s(path.parent, "collector")
        yield lambda: read_reference(reference)
        if next(is_scored_again):
            yield lambda: leaderboard(path.parent)
        yield lambda: measured_results([path])
        run = read_run(path)
        yield lambda: check(run, read_reference(reference))
        for method in (*run.methods[:3], "collector"):
            yield partial(read_update_times, run, method)
            side = Side(run, method)
            yield partial(run.scores, method)
            for protocol in (*list(run.protocols)[:3], "rooms-semantic"):
                yield partial(_checked_counts, side, protocol)

    return lambda: every_one_of(asked())


def _verbs(folder: Path) -> Read:
    """The verbs that read a run folder, from the command line, in turn."""
    run = copied_run(folder)
    called(["check", "--learn", str(run), "--out", str(folder / "reference.json")])
    commands = itertools.cycle(
        [
            ["report", "tables", str(run), "--json"],
            ["report", "timing", str(run)],
            ["report", "leaderboard", str(folder / "runs")],
            ["compare", f"{run}:collector", f"{run}:collector@drop=1", "--per-class"],
            ["check", str(run), "--against", str(folder / "reference.json")],
            ["report", "attribution", str(run), "--method", "collector"],
            ["report", "html", str(run), "--out", str(folder / "page.html")],
            ["runs", "export", str(run), "--to", "openlex3d", "--method", "collector", "--out", str(folder / "out")],
            [*_command(run), "--dry-run"],
            ["runs", "refine", str(run), "--method", "collector"],
            ["datasets", "check", f"{SCENES}/painted.py:Painted/a"],
        ]
    )

    def read() -> None:
        shutil.rmtree(folder / "out", ignore_errors=True)
        called(next(commands))

    return read


def _resumed(folder: Path) -> Read:
    """The same command again on a run folder of which a file was hurt: it mends what it can."""
    import pytest
    from painted import colour_perception

    from su3d_bench.runs import resume as finished_scenes
    from su3d_bench.runs import scene as scene_run

    words = _command(copied_run(folder))

    def read() -> None:
        with pytest.MonkeyPatch.context() as patch:
            for module in (scene_run, finished_scenes):
                patch.setattr(module, "build_perception", colour_perception)
            called(words)

    return read


def _counts(folder: Path) -> Read:
    from su3d_bench.metrics.scoring import unpack_scores

    file = next(_made_run().glob("scenes/*.a/collector/counts.npz"))
    (folder / "counts.npz").write_bytes(file.read_bytes())
    path = folder / "counts.npz"
    return lambda: unpack_scores(path.read_bytes() if path.is_file() else b"")


def _bundle(folder: Path) -> Read:
    """A bundle as it comes from somebody: what a registry reads of it, and what verifies it."""
    from su3d_bench.reproducing.bundle import bundle_runs
    from su3d_bench.reproducing.registry.rows import rows_of_bundle
    from su3d_bench.reproducing.verifying import verify_bundle

    place = folder / "a.zip"
    bundle_runs(place, [_made_run()])
    reads: list[Read] = [partial(rows_of_bundle, place), partial(verify_bundle, place)]
    turns = itertools.cycle(reads)
    return lambda: next(turns)()


def _registry(folder: Path) -> Read:
    """A registry of one bundle that is put together of its parts, all of its digests right, and the site of it."""
    from registry_bundles import read_bundle, rewrite_bundle

    from su3d_bench.reproducing.bundle import bundle_runs
    from su3d_bench.reproducing.registry.folder import read_registry
    from su3d_bench.reproducing.registry.site import write_site
    from su3d_bench.reproducing.verifying import verify_bundle

    bundle_runs(folder / "a.zip", [_made_run()])
    files, manifest = read_bundle(folder / "a.zip")
    (folder / "a.zip").unlink()
    names = [name for name in files if name.endswith(("json", "toml", "counts.npz", "updates.csv"))]
    for name in names:
        (folder / "parts" / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / "parts" / name).write_bytes(files[name])
    place = folder / "registry" / "bundles" / "a.zip"

    def read() -> None:
        parts = {name: folder / "parts" / name for name in names}
        held = {name: path.read_bytes() for name, path in parts.items() if path.is_file()}
        kept = {name: content for name, content in files.items() if name not in parts or name in held}
        rewrite_bundle(place, {**kept, **held}, manifest)
        write_site(read_registry(folder / "registry"), folder / "site")
        verify_bundle(place)

    return read


def _paper(folder: Path) -> Read:
    run, paper = copied_run(folder), folder / "paper.tex"
    called(["report", "tables", str(run), "--format", "latex", "--out", str(paper)])
    return lambda: called(["report", "verify", str(paper), "--root", str(folder)])


def _answers(name: str) -> Make:
    def make(folder: Path) -> Read:
        from counted_sheets import elsewhere, sharing, workbook
        from simulated_annotators import answered, as_csv, retrieval_set

        from su3d_bench.sheets.judging.answers import check_answers, read_answers

        sheet, key = retrieval_set(4)
        rows = answered(sheet, key, {"ann": 0.0})
        book = elsewhere(sharing(workbook(rows))) if name.startswith("moved") else workbook(rows)
        (folder / name).write_bytes(as_csv(rows).encode() if name.endswith("csv") else book)
        return lambda: check_answers(sheet, read_answers(folder / name))

    return make


def _workbook_parts(folder: Path) -> Read:
    """A workbook that is put together of its parts, which lie where its relationships say, before it is read."""
    from counted_sheets import elsewhere, sharing, workbook
    from simulated_annotators import answered, retrieval_set

    from su3d_bench.sheets.judging.answers import check_answers, parse_workbook

    sheet, key = retrieval_set(4)
    content = elsewhere(sharing(workbook(answered(sheet, key, {"ann": 0.0}))))
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        names = archive.namelist()
        archive.extractall(folder)

    def read() -> object:
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
            for name in names:
                archive.writestr(name, (folder / name).read_bytes() if (folder / name).is_file() else b"")
        return check_answers(sheet, parse_workbook(stream.getvalue(), "ann.xlsx"))

    return read


def _sheet_files(folder: Path) -> Read:
    """The set, its key and its scores, through the verb that reads them."""
    from simulated_annotators import answered, as_csv, retrieval_set

    from su3d_bench.sheets.items import write_key, write_sheet

    sheet, key = retrieval_set(4)
    for name in ("sheet", "key"):
        (folder / name).mkdir()
    write_sheet(folder / "sheet", sheet)
    write_key(folder / "key", key)
    (folder / "ann.csv").write_text(as_csv(answered(sheet, key, {"ann": 0.0})))
    words = ["sheets", "score", str(folder / "ann.csv"), "--key", str(folder / "key"), "--json"]
    scores = ["sheets", "score", str(folder / "ann.csv"), "--key", str(folder / "key"), "--out", str(folder / "scores")]
    called(scores)

    def asked() -> Iterator[Read]:
        from su3d_bench.sheets.items import KEY_FILE, SHEET_FILE, read_key, read_sheet
        from su3d_bench.sheets.judging.scores import read_scores

        yield lambda: called(words)
        yield lambda: read_sheet(folder / "sheet" / SHEET_FILE)
        yield lambda: read_key(folder / "key" / KEY_FILE)
        yield lambda: read_scores(folder / "scores")
        yield lambda: called(["report", "tables", str(folder / "scores")])

    return lambda: every_one_of(asked())


def _config(name: str, *more: str) -> Make:
    """A configuration from another run, which is planned but not done."""

    def make(folder: Path) -> Read:
        (folder / name).write_bytes((_made_run() / "run.toml").read_bytes())
        words = [*_command(folder / "b"), "--dry-run", "--config", str(folder / name)]
        return lambda: called([*words, *more])

    return make


def _method_config(folder: Path) -> Read:
    """The settings of all methods of our own in one file."""
    from su3d_bench.core.config import check_keys, read_file, resolve, write_toml
    from su3d_bench.core.registry import METHODS, load
    from su3d_bench.perception.profiles import PerceptionConfig

    classes = {name: load("method", name).Config for name in METHODS}
    leaves: list[Any] = []
    for name, model in classes.items():
        from su3d_bench.core.config import flatten

        try:
            values = model().model_dump(mode="json")
        except ValueError:  # it has settings without defaults
            continue
        leaves += [(("method", name, *path), value, "here") for path, value in flatten(values)]
    (folder / "a.toml").write_text(write_toml(leaves))

    def asked() -> Iterator[Read]:
        settings = read_file(folder / "a.toml")
        yield lambda: check_keys(settings)
        yield lambda: resolve(settings, ("perception",), PerceptionConfig)
        for name, model in classes.items():
            yield partial(resolve, settings, ("method", name), model)

    return lambda: every_one_of(asked())


def _protocol(folder: Path) -> Read:
    from su3d_bench.metrics.protocols.loading import original_of, read_protocol, rules_file

    for name in ("rooms-semantic", "openlex3d-topn", "rooms-instance"):
        (folder / f"{name}.toml").write_bytes(rules_file(name).read_bytes())
    files = sorted(folder.glob("*.toml"))
    return lambda: every_one_of(
        partial(read, str(file)) for file in files for read in (lambda name: read_protocol(Path(name)), original_of)
    )


def _published(folder: Path) -> Read:
    from su3d_bench.reports.tables.papers.published import FILE, read_published

    text = FILE.read_text(encoding="utf-8")
    (folder / "published.toml").write_text("[[figure]]".join(text.split("[[figure]]")[:4]))
    return lambda: read_published(folder / "published.toml")


def _ablation(folder: Path) -> Read:
    from su3d_bench.runs.ablation import ablation_rows, read_rows, write_rows

    write_rows(folder, ablation_rows(COLLECTOR, ["noise_m=0.0,0.3", "drop=1"], is_grid=False))
    return lambda: read_rows(folder)


def _assignments(folder: Path) -> Read:
    """Words of ``--set``, of variants and of ``--vary``, one a line of a file."""
    from su3d_bench.core.config import parse_value, read_assignments
    from su3d_bench.runs.ablation import ablation_rows
    from su3d_bench.runs.plan import named_method

    lines = ("opensu3d.top_m=10", "top_m=10,5", "perception.cache=false", "rooms.width=64", "opensu3d.a='x'")
    (folder / "words.txt").write_text("\n".join(lines))

    def asked() -> Iterator[Read]:
        path = folder / "words.txt"
        text = path.read_bytes().decode("utf-8", "surrogateescape") if path.is_file() else ""
        for word in [line for k, line in enumerate(text.split("\n")[:20]) if k != 1]:
            yield partial(read_assignments, [word], ["opensu3d"], ["rooms"])
            yield partial(parse_value, word)
        assigned, varied = [*text.split("\n"), ""][:2]
        yield lambda: named_method(f"opensu3d@{assigned.removeprefix('opensu3d.')}")
        yield lambda: ablation_rows("opensu3d", [varied], is_grid=True)

    return lambda: every_one_of(asked())


REPLIES: Sequence[str] = (
    '["chair", "a red chair by the wall"]',
    'Sure! ```json\n{"name": "chair", "caption": "a red chair"}\n```',
    "Label: chair\nCaption: a red chair in a scene",
    '{"answer": "the lamp", "ids": [3, 4], "reason": "it is closer"}',
    "The object that is closer is the lamp (id 3), because it stands at 1.2 m.",
    "{'chair': 0.7, 'sofa': 0.3}",
    "I'm sorry, I can't help with that.",
)


def _replies(folder: Path) -> Read:
    """What language models write: read as a description, a name, an answer, whatever they wrote."""
    from su3d_bench.perception.language import parsing

    (folder / "replies.json").write_text(json.dumps(REPLIES))

    def asked() -> Iterator[Read]:
        path = folder / "replies.json"
        content = path.read_bytes() if path.is_file() else b""
        try:
            texts = [one for one in json.loads(content) if isinstance(one, str)]
        except (ValueError, RecursionError, TypeError):
            texts = []
        for text in [*texts[:10], content.decode("utf-8", "replace")]:
            yield partial(parsing.is_refusal, text)
            yield partial(parsing.described, text)
            yield partial(parsing.chosen_name, text, ["chair", "sofa", "armchair"])
            yield partial(parsing.answered, text, [3, 4, 70])
            yield partial(parsing.clean_name, text)

    return lambda: every_one_of(asked())


def _cached_frame(folder: Path) -> Read:
    from su3d_bench.perception.cache import FrameCache, content_key, pack_masks, unpack_masks

    cache, key = FrameCache(folder / "cache"), content_key("a")
    cache.save(key, {**pack_masks(np.eye(5, dtype=bool)[None]), "names": np.array(["cup"])})

    def read() -> None:
        entry = cache.load(key)
        if entry is not None:
            unpack_masks(entry)

    return read


RUN = "runs/a"
JOB = "runs/a/scenes/*/collector"
TARGETS = (
    Target("run record", _run, (f"{RUN}/run.json",), 0.15),
    Target("run metrics", _run, (f"{RUN}/metrics.json",), 0.15),
    Target("run settings", _run, (f"{RUN}/run.toml",), 0.15),
    Target("run seals", _run, (f"{JOB}/done.json",), 0.15),
    Target("run updates", _run, (f"{JOB}/updates.csv",), 0.15),
    Target("run counts", _run, (f"{JOB}/counts.npz",), 0.15),
    Target("reference", _run, ("reference.json",), 0.15),
    Target("run verbs", _verbs, (f"{RUN}/*.json", f"{RUN}/run.toml", f"{JOB}/*", "reference.json"), 0.05),
    Target("run resumed", _resumed, (f"{RUN}/**/*",), 0.02),
    Target("run packed counts", _counts, ("counts.npz",)),
    Target("bundle", _bundle, ("a.zip",), 0.15),
    Target("registry", _registry, ("parts/**/*",), 0.05),
    Target("paper", _paper, ("paper.tex",), 0.15),
    Target("answers.csv", _answers("ann.csv"), ("ann.csv",)),
    Target("answers.xlsx", _answers("bob.xlsx"), ("bob.xlsx",), 0.3),
    Target("answers moved", _answers("moved.xlsx"), ("moved.xlsx",), 0.3),
    Target("answers in parts", _workbook_parts, ("**/*",), 0.5),
    Target("sheet files", _sheet_files, ("sheet/*.json", "key/*.json", "scores/scores.json"), 0.05),
    Target("config of a run", _config("a.toml"), ("a.toml",), 0.05),
    Target("config of methods", _method_config, ("a.toml",)),
    Target("protocol", _protocol, ("*.toml",)),
    Target("published", _published, ("published.toml",)),
    Target("ablation", _ablation, ("ablation.json",)),
    Target("assignments", _assignments, ("words.txt",)),
    Target("replies", _replies, ("replies.json",)),
    Target("cached frame", _cached_frame, ("cache/**/*",)),
)
