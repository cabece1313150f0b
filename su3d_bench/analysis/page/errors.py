"""What the errors of a method cost, for a page: formed from the mended counts of single scenes, which can be kept."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

import numpy as np

from su3d_bench.analysis.attribution import Explained, MendedJob
from su3d_bench.core.errors import DataError, Su3dError
from su3d_bench.metrics.attribution.arrays import EXPLAINED, MendedScene
from su3d_bench.metrics.attribution.masks import Mended, MendedPoints
from su3d_bench.metrics.instance.average_precision import InstanceCounts
from su3d_bench.metrics.matching.nearest import COVERAGE_RADII_M
from su3d_bench.metrics.metric import Counts, SceneScore
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import metric_of, pack_scores, unpack_scores

RulesOf = Callable[[str], ProtocolRules]
AS_IS, ALL, LABELLED = "as it is", "all mended", "true labels"  # beside the kinds of errors, each mended alone


def errors_of(explained: Explained | str, method: str, of_scenes: Mapping[str, MendedJob | str]) -> dict[str, Any]:
    """The errors of a method as a page holds them; a text in the place of what cannot be had is their reason."""
    reasons = [explained] if isinstance(explained, str) else [one for one in of_scenes.values() if isinstance(one, str)]
    try:
        if not isinstance(explained, str) and not reasons:
            mended = {scene: one for scene, one in of_scenes.items() if not isinstance(one, str)}
            return {**explained.form(mended).to_json(), "reason": None}
    except Su3dError as error:
        reasons = [str(error)]
    return {"method": method, "protocols": [], "remarks": [], "reason": reasons[0]}


def packed(mended: MendedJob, rules_of: RulesOf) -> bytes:
    """The counts of a scene under a method as the bytes of an npz file; ``rules_of`` finds a protocol by its name."""
    scores: dict[str, SceneScore] = {}
    for protocol, of_scene in mended.items():
        parts = {AS_IS: of_scene.as_is, ALL: of_scene.all, LABELLED: of_scene.with_true_labels, **of_scene.alone}
        for part, counts in parts.items():
            if counts is not None:
                name, n = f"{protocol} {part}", of_scene.n.get(part, 0)
                version, nowhere = rules_of(protocol).version, np.zeros(len(COVERAGE_RADII_M), np.int64)
                scores[name] = SceneScore(name, version, counts, n, of_scene.n_scored or 0, nowhere, ())
    return pack_scores(scores)


def unpacked(content: bytes, rules_of: RulesOf) -> MendedJob | None:
    """What ``packed`` packed; None for anything else."""
    with suppress(Su3dError, KeyError):
        scores = unpack_scores(content)
        names = dict.fromkeys(name.partition(" ")[0] for name in scores)
        return {name: _of_protocol(rules_of(name), scores) for name in names}
    return None


def _of_protocol(rules: ProtocolRules, scores: Mapping[str, SceneScore]) -> MendedScene:
    def counts(part: str) -> Any:
        found: Counts = scores[f"{rules.name} {part}"].counts
        if not isinstance(found, metric_of(rules).counts):
            raise DataError(f"{rules.name}: these are no counts of its kind")
        metric_of(rules).check(rules.name, found)
        return found

    as_is, everything = counts(AS_IS), counts(ALL)
    labelled = counts(LABELLED) if f"{rules.name} {LABELLED}" in scores else None
    kinds = EXPLAINED[rules.kind][0]
    alone = {kind: counts(kind) for kind in kinds}
    n = {kind: scores[f"{rules.name} {kind}"].n_predictions for kind in kinds}
    if isinstance(as_is, InstanceCounts):
        return Mended(as_is, alone, everything, n, labelled)
    return MendedPoints(as_is, alone, everything, labelled, n, scores[f"{rules.name} {AS_IS}"].n_scored)
