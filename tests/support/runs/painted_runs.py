"""Runs of painted scenes: their command lines and results."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from painted import WordEncoder, colour_perception
from places import SCENES

from su3d_bench.cli.main import main
from su3d_bench.core.digests import digest_file, digest_json
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.scoring import combine, unpack_scores
from su3d_bench.runs import finished as finished_run
from su3d_bench.runs import scene as scene_run
from su3d_bench.runs.existing import SEAL, with_end_marker
from su3d_bench.store.run_folder import scene_of_folder

PAINTED = f"{SCENES}/painted.py:Painted"
COLLECTOR = f"{SCENES}/painted.py:Collector"
PROTOCOLS = ["--protocols", "rooms-semantic", "rooms-instance"]


def see_painted(patch: pytest.MonkeyPatch) -> None:
    """Makes this process find painted scenes, and encode texts like their perception."""
    patch.setattr(scene_run, "build_perception", colour_perception)
    patch.setattr(finished_run, "encoder_of", lambda run, device="cpu": WordEncoder())


def _protocols(more: Sequence[str]) -> list[str]:
    return [] if "--protocols" in more else PROTOCOLS  # an option of several values adds to those before


def words(*more: str, scenes: str = "*", out: str = "out") -> list[str]:
    base = ["run", "--scenes", f"{PAINTED}/{scenes}", "--methods", COLLECTOR, *_protocols(more), "--no-pictures"]
    return [*base, "--jobs", "1", "--out", out, *more]


def run(*more: str, scenes: str = "*", out: str = "out") -> int:
    return main(words(*more, scenes=scenes, out=out))


def in_process(*more: str, out: str = "out") -> list[str]:
    return [sys.executable, str(SCENES / "painted_cli.py"), *words(*more, out=out)]


def metrics(out: str = "out") -> dict[str, Any]:
    loaded: dict[str, Any] = json.loads(Path(out, "metrics.json").read_text())
    return loaded


def job(scene: str = "a", method: str = "collector", out: str = "out") -> Path:
    return Path(out, "scenes", f"painted.{scene}", method)


def painted_run(folder: Path, *more: str, methods: Sequence[str] = (COLLECTOR,), scenes: str = "ab") -> Path:
    """A finished run of some scenes, created in this process."""
    named = ["run", *(f"{PAINTED}/{scene}" for scene in scenes), "--methods", *methods, "--no-pictures"]
    with pytest.MonkeyPatch.context() as patch:
        see_painted(patch)
        assert main([*named, *_protocols(more), "--jobs", "1", "--out", str(folder), *more]) == 0
    return folder


def consistent(run: Path) -> Path:
    """The run with jobs, results and end marker that agree with its run.json, run.toml and counts."""
    record = json.loads((run / "run.json").read_text())
    toml = run / "run.toml"
    toml.write_text(with_end_marker(toml.read_text().rpartition(SEAL)[0]))
    scores: dict[str, dict[str, dict[str, SceneScore]]] = {}  # method -> protocol -> scene -> counts
    for done in run.rglob("done.json"):
        value, scene = json.loads(done.read_text()), scene_of_folder(done.parent.parent.name)
        predict, score = (value["steps"][step]["key"] for step in ("predict", "score"))
        predict |= {"seed": str(record["seed"]), "data": record["data_digests"][scene]}
        predict |= {"profile": record["profile"]} if "profile" in predict else {}
        score |= {"predict": digest_json(predict), "encoder": record["encoder_digest"]}
        score |= {f"protocol.{one['name']}": one["digest"] for one in record["protocols"]}
        for step in value["steps"].values():
            step["files"] = {name: digest_file(done.parent / name) for name in step["files"]}
        done.write_text(json.dumps(value))
        for protocol, one in unpack_scores((done.parent / "counts.npz").read_bytes()).items():
            scores.setdefault(done.parent.name, {}).setdefault(protocol, {})[scene] = one
    metrics = json.loads((run / "metrics.json").read_text()) | {"seed": record["seed"]}
    for result in metrics["results"]:
        rules, of_method = load_protocol(result["protocol"]), scores[result["method"]][result["protocol"]]
        result["result"] = combine(rules, of_method).to_json()
        if result["ceiling"] is not None:
            result["ceiling"] = combine(rules, scores["oracle"][result["protocol"]]).to_json()["metrics"]
        result["encoder_digest"] = record["encoder_digest"]
        if result["profile"] is not None:
            result["profile"] = record["profile"]
    (run / "metrics.json").write_text(json.dumps(metrics))
    return run


def painted_page(run: Path, page: Path, *more: str) -> str:
    """The page of a run, created with the encoder of painted scenes."""
    with pytest.MonkeyPatch.context() as patch:
        see_painted(patch)
        assert main(["report", "html", str(run), "--out", str(page), "--quiet", "--jobs", "1", *more]) == 0
    return page.read_text(encoding="utf-8")
