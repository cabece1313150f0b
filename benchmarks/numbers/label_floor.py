"""Contribution of labels to a run's score: the same masks with one label, and with random labels.

``python benchmarks label_floor RUN`` prints a Markdown table of OpenSU3D's headline metrics on the rooms as run,
with the class of most objects as the only label, and with random labels (the mean of 3 draws).
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from su3d_bench.core.maps import Instances
from su3d_bench.core.types import GroundTruth
from su3d_bench.datasets.rooms.dataset import Rooms
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import combine, score_scene
from su3d_bench.perception.embedded.encoder import EmbeddedEncoder
from su3d_bench.runs.scenes import data_root
from su3d_bench.store.predictions import read_prediction
from su3d_bench.store.run_folder import RunFolder

PROTOCOLS = ("rooms-semantic", "rooms-instance")
N_DRAWS = 3
Labels = Callable[[int], Sequence[str]] | None


def scored(
    rules: ProtocolRules, scenes: dict[str, tuple[GroundTruth, Instances]], labels: Labels, encoder: EmbeddedEncoder
) -> list[float]:
    """Headline values with the labels that ``labels`` returns for that many instances, or the map's own labels."""
    scores = {}
    for scene, (truth, instances) in scenes.items():
        named = instances if labels is None else replace(instances, labels=tuple(labels(len(instances))))
        scores[scene] = score_scene(rules, truth, named, encoder)
    metrics = combine(rules, scores).metrics
    return [metrics[name] for name in rules.headline]


def _most_common(rules: ProtocolRules, truths: Sequence[GroundTruth]) -> str:
    """The scored class with most objects."""
    name_of = {entry.id: entry.name for entry in rules.scored}
    counts: Counter[str] = Counter()
    for truth in truths:
        for _, first in zip(*np.unique(truth.instance, return_index=True), strict=True):
            if int(truth.semantic[first]) in name_of:
                counts[name_of[int(truth.semantic[first])]] += 1
    return counts.most_common(1)[0][0]


def _random_labels(names: Sequence[str], seed: int) -> Labels:
    rng = np.random.default_rng(seed)
    return lambda n: rng.choice(names, n).tolist()


def main(run: Path) -> int:
    rooms, encoder = Rooms(data_root(), Rooms.Options()), EmbeddedEncoder()
    scenes = {}
    for folder in sorted((run / "scenes").glob("rooms.*")):
        scene = folder.name.removeprefix("rooms.")
        prediction = read_prediction(RunFolder(run).job(f"rooms/{scene}", "opensu3d").prediction)
        assert isinstance(prediction, Instances)
        scenes[scene] = (rooms.ground_truth(scene, "mesh-vertices"), prediction)
    print("| protocol | metrics | as run | single label | random labels |\n|---|---|---|---|---|")
    for name in PROTOCOLS:
        rules = load_protocol(name)
        names = [entry.name for entry in rules.scored]
        own = scored(rules, scenes, None, encoder)
        common = _most_common(rules, [truth for truth, _ in scenes.values()])
        single = scored(rules, scenes, lambda n, one=common: [one] * n, encoder)
        random = np.mean([scored(rules, scenes, _random_labels(names, draw), encoder) for draw in range(N_DRAWS)], 0)
        cells = [" / ".join(f"{100 * value:.1f}" for value in values) for values in (own, single, random)]
        cells[1] += f" ({common})"
        print(f"| {name} | {' / '.join(rules.headline)} | " + " | ".join(cells) + " |")
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
