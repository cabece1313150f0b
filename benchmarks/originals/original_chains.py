"""Beacon3D's grounding script on synthetic chains of texts with right and wrong answers."""

from __future__ import annotations

import contextlib
import io
import json
import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from original_code import Ask, Original, load

from su3d_bench.core.types import Float64Array
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.questions.beacon3d import answered_file

FILE = "evaluate_grounding.py"
KNOWLEDGE = ("class", "appearance", "geometry", "spatial", "functionality")
PRINTED = ("case", *KNOWLEDGE, "chain", "object", "both", "coarse alone", "fine alone", "neither")
Problem = dict[str, Any]  # ``metadata`` as in Beacon3D's file, and of each text in its order whether it is ``correct``


def drawn(seed: int, index: int) -> Problem:
    """Problem ``index``: texts that chains share, chains of one to four texts, mostly right or wrong answers."""
    rng = np.random.default_rng([seed, index, 23])
    metadata: dict[str, Any] = {}
    for s in range(rng.integers(1, 4)):
        tag_of: dict[str, str] = {}
        for k in range(rng.integers(1, 5)):
            chains = {}
            for c in (1, 2, 3):
                texts = [f"the {rng.choice(['red', 'tall'])} thing {k}-{c}-{n}" for n in range(rng.integers(1, 4))]
                texts += [str(rng.choice(["box", "a chair"]))] if rng.random() < 0.7 else []
                for text in texts:
                    tag_of.setdefault(text, "-".join(rng.choice(KNOWLEDGE, rng.integers(1, 4), replace=False)))
                chains[f"chain_{c}"] = [{"text": text, "obj_id": [str(k)], "tag": tag_of[text]} for text in texts]
            metadata.setdefault(f"scene{s:04d}_00", {}).setdefault(f"class{k % 2}", {})[str(k)] = chains
    share = rng.choice([0.1, 0.5, 0.8, 1.0])
    return {"metadata": metadata, "correct": (rng.random(len(_asked(metadata))) < share).astype(int).tolist()}


def _asked(metadata: Any) -> list[tuple[str, str, str]]:
    """The scene, text and tag of each distinct text, in the order of the file."""
    items = [
        (scene, item["text"], item["tag"])
        for scene, classes in metadata.items()
        for objects in classes.values()
        for chains in objects.values()
        for chain in chains.values()
        for item in chain
    ]
    return list(dict.fromkeys(items))


def beacon3d(rules: ProtocolRules, checkout: Path, folder: Path) -> Ask:
    """The values that the script prints, in percent with two digits."""
    module = load(checkout / FILE, [])

    def ask(problem: Problem) -> Float64Array:
        asked = _asked(problem["metadata"])
        data = [{"scan_id": scene, "utterance": text, "item_id": f"0_{tag}"} for scene, text, tag in asked]
        found = module.build_results_mapping(data, [{"correct": one} for one in problem["correct"]])
        chains = module.process_to_metadata(problem["metadata"], found)
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            module.eval_score(found, chains)
            module.eval_chain(chains)
        return np.array(re.findall(r"[\d.]+\.\d\d", printed.getvalue()), float)

    return ask


def ours(rules: ProtocolRules, problem: Problem) -> Float64Array:
    """The same by this program, rounded as printed."""
    with tempfile.TemporaryDirectory() as folder:
        files = Path(folder) / "metadata_scannet.json", Path(folder) / "answers.json"
        files[0].write_text(json.dumps(problem["metadata"]))
        files[1].write_text(json.dumps([{"correct": one} for one in problem["correct"]]))
        found = {one.name: one.least for one in answered_file(*files).numbers}
    found["both"] = found["chain"]  # all texts of a chain are right
    return np.array([f"{100 * found[name]:.2f}" for name in PRINTED], float)


def keep(rules: ProtocolRules, ask: Ask, seed: int, n: int) -> None:
    """Its answers are in tests/cases/beacon3d01_answers already."""
    raise SystemExit("no new cases of these problems; compare without --cases")


ORIGINALS = (Original(("beacon3d",), FILE, beacon3d, drawn, ours, keep),)
