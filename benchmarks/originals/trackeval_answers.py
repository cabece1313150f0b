"""Answers of trackeval 1.3.0 and of deeplab2's STQ to generated sequences, in tests/metrics/identity_answers.json.

Run it once in an environment of its own for each original, because they need different versions of numpy:

    pip install trackeval==1.3.0
    python benchmarks trackeval_answers tests/metrics/identity_answers.json

    pip install "numpy<2"
    python benchmarks trackeval_answers tests/metrics/identity_answers.json --deeplab2 ~/deeplab2

The checkout is of google-research/deeplab2 at commit 64bc1c1; only a file that needs nothing but numpy is run. With
numpy 2 it would divide float32 numbers. An undefined answer is null.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import math
import warnings
from pathlib import Path
from typing import Any

import folders  # noqa: F401 - lets the next one be found
import numpy as np
import synthetic_tracks as synthetic

CURVES = ("HOTA", "DetA", "DetRe", "DetPr", "AssA", "LocA", "OWTA")
IDENTITY = ("IDF1", "IDP", "IDR")
STQ_FILE = "evaluation/numpy/segmentation_and_tracking_quality.py"
SHIFT = 8  # bits of an instance number


def in_trackeval(steps: list[synthetic.Track]) -> dict[str, Any]:
    """A sequence as trackeval's datasets pass it to metrics: ids from 0 without gaps."""
    answer: dict[str, Any] = {"similarity_scores": [step[2] for step in steps]}
    for place, side in enumerate(("gt", "tracker")):
        distinct = np.unique(np.concatenate([np.zeros(0, int), *(step[place] for step in steps)]))
        answer[f"{side}_ids"] = [np.searchsorted(distinct, step[place]) for step in steps]
        answer[f"num_{side}_ids"] = len(distinct)
        answer[f"num_{side}_dets"] = sum(len(step[place]) for step in steps)
    return answer


def answers_of_trackeval() -> dict[str, Any]:
    from trackeval.metrics import HOTA, Identity

    metrics = HOTA(), Identity({"PRINT_CONFIG": False})
    problems = [in_trackeval(synthetic.track_problem(seed)) for seed in range(synthetic.N_TRACKS)]
    hota, identity = ([metric.eval_sequence(problem) for problem in problems] for metric in metrics)
    whole = [m.combine_sequences(dict(enumerate(each))) for m, each in zip(metrics, (hota, identity), strict=True)]
    rows = [*zip(hota, identity, strict=True), whole]
    return {
        "source": "trackeval 1.3.0",
        "columns": [*CURVES, *IDENTITY],
        "values": [[*(float(np.mean(h[k])) for k in CURVES), *(float(i[k]) for k in IDENTITY)] for h, i in rows],
        "curves": [[h[name].tolist() for name in CURVES] for h in (*hota[: synthetic.N_CURVES], whole[0])],
        "last": "all sequences together",
    }


def answers_of_deeplab2(checkout: Path) -> dict[str, Any]:
    assert np.__version__ < "2", "numpy 2 computes its ratios in single precision"
    spec = importlib.util.spec_from_file_location("stq", checkout / STQ_FILE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    rows = []
    for group in range(0, synthetic.N_POINTS, synthetic.N_TOGETHER):
        seeds = range(group, group + synthetic.N_TOGETHER)
        rows += [answer(module, [seed]) for seed in seeds] + [answer(module, list(seeds))]
    return {
        "source": f"google-research/deeplab2 at 64bc1c1, {STQ_FILE}, numpy 1",
        "columns": ["STQ", "AQ", "SQ"],
        "values": rows,
        "last": f"after {synthetic.N_TOGETHER} sequences these together",
    }


def answer(module: Any, seeds: list[int]) -> list[float | None]:
    """STQ, AQ and IoU; with even groups void is a class beyond the others, with odd ones it is class 0."""
    things = synthetic.is_thing(seeds[0])
    first = seeds[0] // synthetic.N_TOGETHER % 2
    ignored = 0 if first else 200
    things_list = (first + np.flatnonzero(things)).tolist()
    metric = module.STQuality(len(things) + first, things_list, ignored, SHIFT, 1 << 20)
    for seed in seeds:
        for true_class, true_id, class_index, ids in synthetic.point_problem(seed):
            true, found = (np.where(each < 0, ignored, each + first) for each in (true_class, class_index))
            metric.update_state((true << SHIFT) + true_id, (found << SHIFT) + ids, seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # without a labelled point it divides by 0
        result = metric.result()
    values = [float(result[name]) for name in ("STQ", "AQ", "IoU")]
    return [None if math.isnan(value) else value for value in values]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("--deeplab2", type=Path, help="answers of the STQ in this checkout instead of trackeval's")
    arguments = parser.parse_args()
    kept = json.loads(arguments.file.read_text()) if arguments.file.exists() else {}
    if arguments.deeplab2 is None:
        kept["tracks"] = answers_of_trackeval()
    else:
        kept["points"] = answers_of_deeplab2(arguments.deeplab2)
    arguments.file.write_text(json.dumps(kept, separators=(",", ":"), sort_keys=True) + "\n")


if __name__ == "__main__":
    main()
