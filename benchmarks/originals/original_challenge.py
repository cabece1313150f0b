"""The OpenSUN3D challenge's script on synthetic maps whose instances are ranked by the query of each scene."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import numpy as np
from original_code import Ask, Original, load
from original_derived import OPENSUN3D
from original_instances import emptied

from su3d_bench.core.maps import Instances
from su3d_bench.core.types import Float64Array
from su3d_bench.datasets.arkitscenes.challenge import TRUTH_FOLDER, Challenge, answered
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import combine, score_scene
from su3d_bench.questions.ground_truths import question_truth

AXES = "ab"  # the query of a scene is one of the first two axes of its features
VALUES = (0, 0, 1, 2, 999, 1000, 1002, 1999, 2003, 5001, 70001)  # n and 1000 + n are one object, and from 2000 none
Problem = list[
    dict[str, Any]
]  # of each scene the ``truth`` of each point, ``masks``, their ``features``, the ``query``


def drawn(seed: int, index: int) -> Problem:
    """Problem ``index``: background, values of one object or none, empty, equal and other masks, equal cosines."""
    rng = np.random.default_rng([seed, index, 19])
    scenes = []
    for _ in range(rng.integers(1, 4)):
        sizes = rng.integers(1, 12, rng.integers(1, 7))
        truth = rng.permutation(np.repeat(rng.choice(VALUES, len(sizes)), sizes))
        if rng.random() < 0.7:
            truth = np.sort(truth)
        masks: list[list[int]] = []
        for _ in range(rng.choice([0, 1, 2, 4, 7])):
            near = np.flatnonzero(truth == rng.choice(truth))
            chosen = rng.choice(len(truth), rng.integers(0, 4)) if rng.random() < 0.5 else near[: rng.integers(0, 3)]
            one = np.setxor1d(near, chosen) if rng.random() < 0.95 else np.zeros(0, int)
            masks.append(masks[-1] if masks and rng.random() < 0.15 else one.tolist())
        features = rng.integers(-30, 31, (len(masks), 3)) * 2 + 1  # no zero vector
        if len(masks) > 1 and rng.random() < 0.3:
            features[-1] = features[0]
        scenes.append(
            {
                "truth": truth.tolist(),
                "masks": masks,
                "features": features.tolist(),
                "query": AXES[rng.integers(2)],
            }
        )
    return scenes


def challenge(rules: ProtocolRules, checkout: Path, folder: Path) -> Ask:
    """AP, AP50 and AP25 with the cosines as confidences."""
    module = load(checkout / OPENSUN3D, [checkout / "challenge_track_1"], absent=["plyfile", "imageio"])

    def ask(problem: Problem) -> Float64Array:
        truth, predicted = emptied(folder / "gt"), {}
        for s, scene in enumerate(problem):
            np.savetxt(truth / f"{s}.txt", scene["truth"], fmt="%d")
            masks = np.zeros((len(scene["truth"]), len(scene["masks"])), bool)
            for k, mask in enumerate(scene["masks"]):
                masks[mask, k] = True
            features = np.array(scene["features"], np.float64).reshape(-1, 3)
            cosines = features[:, AXES.index(scene["query"])] / np.linalg.norm(features, axis=1)
            predicted[str(s)] = {"pred_masks": masks, "pred_scores": cosines, "pred_classes": np.ones(len(cosines))}
        module.opt["min_region_sizes"] = np.array([rules.min_region_size])
        found = module.evaluate(predicted, str(truth))
        return np.array([found[name] / 100 for name in ("all_ap", "all_ap_50%", "all_ap_25%")], float)

    return ask


class _Axes:
    """Encodes the queries as the first axes."""

    name, dim, digest = "axes", 3, "axes"

    def encode_texts(self, texts: Any) -> Any:
        return np.eye(3, dtype=np.float32)[[AXES.index(text) for text in texts]]


def ours(rules: ProtocolRules, problem: Problem) -> Float64Array:
    """The same by this program, from the ground truth's files."""
    scores, encoder = {}, _Axes()
    with TemporaryDirectory() as folder:
        (Path(folder) / TRUTH_FOLDER).mkdir(parents=True)
        for s, scene in enumerate(problem):
            name = f"{s:08d}"
            np.savetxt(Path(folder) / TRUTH_FOLDER / f"{name}.txt", scene["truth"], fmt="%d")
            points = np.zeros((len(scene["truth"]), 3), np.float32)
            points[:, 0] = np.arange(len(points))
            features = np.array(scene["features"], np.float32).reshape(-1, 3)
            found = Instances.of(points, [np.array(mask, np.int64) for mask in scene["masks"]], None, features)
            truth = Challenge(Path(folder)).ground_truth(name, points)
            dataset: Any = SimpleNamespace(name="made", queries=lambda _, t=truth, q=scene["query"]: [answered(t, q)])
            scores[name] = score_scene(rules, question_truth(rules, dataset, name, truth), found, encoder)  # type: ignore[arg-type]
    values = combine(rules, scores, with_intervals=False).metrics
    return np.array([values[name] for name in ("AP", "AP50", "AP25")], float)


def keep(rules: ProtocolRules, ask: Ask, seed: int, n: int) -> None:
    """Its answers are in tests/cases/opensun3d02_queries already."""
    raise SystemExit("no new cases of these problems; compare without --cases")


ORIGINALS = (Original(("opensun3d-queries",), OPENSUN3D, challenge, drawn, ours, keep),)
