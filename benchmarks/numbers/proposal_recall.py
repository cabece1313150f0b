"""Recall of 3D proposals: the upper bound for methods that describe them.

``python benchmarks proposal_recall rooms/living0 rooms/office0`` prints a Markdown table with one row for the
geometric proposals of each method based on proposals and, with ``--folder DIR``, one for those in files. An
object counts if it is scored and large enough in the protocol, and is covered if a proposal has the IoU.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from su3d_bench.baselines.openmask3d.method import OpenMask3DConfig, OpenMask3DSegment3DConfig
from su3d_bench.baselines.openmask3d.proposals import ProposalConfig, make_proposals
from su3d_bench.core import registry
from su3d_bench.core.maps import Proposals
from su3d_bench.core.types import Float64Array, GroundTruth
from su3d_bench.metrics.matching.transfer import transfer_masks
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.runs.scenes import data_root

LIMITS = (0.25, 0.5, 0.75)


def best_ious(rules: ProtocolRules, truth: GroundTruth, proposals: Proposals) -> Float64Array:
    """For each counted object (O,) the largest IoU of a proposal with it, on the points of the ground truth."""
    scored = [entry.id for entry in rules.scored]
    ids, first, n = np.unique(truth.instance, return_index=True, return_counts=True)
    counts = (ids > 0) & np.isin(truth.semantic[first], scored) & (n >= (rules.min_region_size or 1))
    row = np.searchsorted(ids, truth.instance)
    masks = transfer_masks(proposals.points, proposals, truth.points)
    best = np.zeros(len(ids))
    for k in range(len(masks)):
        members = masks.mask(k)
        shared = np.bincount(row[members], minlength=len(ids))
        best = np.maximum(best, shared / (n + len(members) - shared))
    return best[counts]


def measured(config: ProposalConfig, scenes: list[str], rules: ProtocolRules, dataset_of: Callable[[str], Any]) -> str:
    """A row of the table, after the name: number, recalls, mean IoU, seconds per scene."""
    found, n_proposals, seconds = [], 0, []
    for scene in scenes:
        name, _, own = scene.partition("/")
        dataset = dataset_of(name)
        surface, truth = dataset.surface(own), dataset.ground_truth(own, rules.ground_truth)
        start = time.perf_counter()
        tools: Any = SimpleNamespace(surface=lambda surface=surface: surface, true_proposals=None)
        proposals = make_proposals(config, tools, name, own)
        seconds.append(time.perf_counter() - start)
        n_proposals += len(proposals)
        found.append(best_ious(rules, truth, proposals))
    best = np.concatenate(found)
    recalls = " | ".join(f"{100 * (best > limit).mean():.0f}" for limit in LIMITS)
    return f"{n_proposals} | {len(best)} | {recalls} | {best.mean():.2f} | {np.median(seconds):.1f}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", help="dataset/scene")
    parser.add_argument("--protocol", default="rooms-instance")
    parser.add_argument("--folder", type=Path, help="proposals in files")
    arguments = parser.parse_args()
    rules = load_protocol(arguments.protocol)
    datasets: dict[str, Any] = {}

    def dataset_of(name: str) -> Any:
        if name not in datasets:
            cls = registry.load("dataset", name)
            datasets[name] = cls(data_root(), cls.Options())
        return datasets[name]

    rows: list[tuple[str, ProposalConfig]] = [
        ("surface, openmask3d", OpenMask3DConfig()),
        ("surface, openmask3d-segment3d", OpenMask3DSegment3DConfig()),
    ]
    if arguments.folder is not None:
        rows.append((str(arguments.folder), ProposalConfig(proposals_folder=arguments.folder)))
    print("| proposals | number | objects | recall at IoU 0.25, % | at 0.5 | at 0.75 | mean best IoU | s per scene |")
    print("|---|---|---|---|---|---|---|---|")
    for name, config in rows:
        print(f"| {name} | {measured(config, arguments.scenes, rules, dataset_of)} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
