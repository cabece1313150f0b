"""Retrieval accuracy of the four fusion schemes on built-in rooms, by kind of query, against the rooms' own truth.

``python benchmarks/retrieval_by_scheme.py --out runs`` runs what is missing and prints a Markdown table. A query is
answered rightly when the instance ranked first covers an object that answers it: of all truth vertices whose nearest
map point (within 5 cm) belongs to the instance, most belong to that object. ``chance`` draws an instance at random.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from su3d_bench.datasets.rooms import Rooms
from su3d_bench.datasets.rooms_truth import Query, queries
from su3d_bench.metrics.transfer import nearest
from su3d_bench.opensu3d.retrieval import rank_all
from su3d_bench.perception.embedded_encoder import EmbeddedEncoder
from su3d_bench.planning import data_root
from su3d_bench.store import RunFolder, read_prediction
from su3d_bench.types import GroundTruth, Instances, Int64Array

SCHEMES = ("scheme1", "scheme2", "scheme3", "scheme4")
KINDS = ("instance", "affordance", "property", "relative")
CAP_M = 0.05


def objects_of(instances: Instances, truth: GroundTruth) -> Int64Array:
    """The object that each instance covers most of all, 0 where it covers none."""
    _, covered = nearest(instances.points, truth.points, CAP_M)
    found = np.zeros(len(instances), np.int64)
    for k in range(len(instances)):
        inside = np.zeros(len(instances.points), np.bool_)
        inside[instances.mask(k)] = True
        owners = truth.instance[(covered >= 0) & inside[np.maximum(covered, 0)]]
        counts = np.bincount(owners[owners > 0])
        found[k] = counts.argmax() if len(counts) else 0
    return found


def scores(instances: Instances, truth: GroundTruth, asked: Sequence[Query], encoder: EmbeddedEncoder) -> list[bool]:
    objects = objects_of(instances, truth)
    rankings = rank_all(instances, [query.text for query in asked], encoder)
    return [bool(objects[r.order[0]] in q.answers) for r, q in zip(rankings, asked, strict=True)]


def chances(instances: Instances, truth: GroundTruth, asked: Sequence[Query]) -> list[float]:
    objects = objects_of(instances, truth)
    return [float(np.isin(objects, query.answers).mean()) for query in asked]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs"), help="where the four run folders are")
    parser.add_argument("--scenes", nargs="+", default=["rooms/*"])
    parser.add_argument("--profile", default="embedded")
    arguments = parser.parse_args()
    rooms, encoder = Rooms(data_root(), Rooms.Options()), EmbeddedEncoder()
    right: dict[tuple[str, str], list[float]] = {}
    for scheme in SCHEMES:
        folder = arguments.out / f"retrieval-{arguments.profile}-{scheme}"
        command = [sys.executable, "-m", "su3d_bench", "run", "--quiet", "--out", str(folder), "--methods", "opensu3d"]
        command += ["--scenes", *arguments.scenes, "--profile", arguments.profile, "--set", f"opensu3d.scheme={scheme}"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        for job in sorted((folder / "scenes").glob("rooms.*")):
            scene = job.name.removeprefix("rooms.")
            prediction = read_prediction(RunFolder(folder).job(f"rooms/{scene}", "opensu3d").prediction)
            assert isinstance(prediction, Instances)
            truth = rooms.ground_truth(scene, "mesh-vertices")
            asked = queries(rooms.truth(scene), rooms.visible_vertices(scene))
            for query, is_right in zip(asked, scores(prediction, truth, asked, encoder), strict=True):
                right.setdefault((scheme, query.kind), []).append(float(is_right))
            if scheme == SCHEMES[0]:
                for query, chance in zip(asked, chances(prediction, truth, asked), strict=True):
                    right.setdefault(("chance", query.kind), []).append(chance)
    print("| | " + " | ".join(f"{kind} ({len(right[SCHEMES[0], kind])})" for kind in KINDS) + " |")
    print("|---|" + "---|" * len(KINDS))
    for row in (*SCHEMES, "chance"):
        print(f"| {row} | " + " | ".join(f"{np.mean(right[row, kind]):.2f}" for kind in KINDS) + " |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
