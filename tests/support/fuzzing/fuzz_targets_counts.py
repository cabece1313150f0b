"""What reads the counts of a scene that a run kept, of kinds that no made run has: a sample and the call."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fuzzing import Make, Read, Target
from scored_room import ENCODER, room, truth_as_prediction

from su3d_bench.metrics.open_vocabulary.query_ap import TextQuery
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.questions.score import AskedThing, PresenceTruth
from su3d_bench.metrics.scoring import combine, pack_scores, score_scene, unpack_scores
from su3d_bench.questions.files.queries import query_truth

KEPT_COUNTS = ("rooms-panoptic", "rooms-top-k", "rooms-presence", "grounding", "query-ap")


def _kept_counts(name: str) -> Make:
    """The counts of a scene under a protocol, read again and made a number of."""

    def make(folder: Path) -> Read:
        rules, path = load_protocol(name), folder / "counts.npz"
        truth: Any = room()
        prediction = truth_as_prediction(truth, with_labels=False)
        if rules.kind == "presence":
            asked = (AskedThing("chair", "random", is_there=True), AskedThing("bed", "random", is_there=False))
            truth = PresenceTruth(truth, asked, "made")
        elif rules.kind in ("queries", "grounding"):
            truth = query_truth(truth, (TextQuery("a chair", (2, 3)), TextQuery("a lamp", (5,))), "made")
        path.write_bytes(pack_scores({name: score_scene(rules, truth, prediction, ENCODER)}))

        def read() -> None:
            for of_protocol, score in unpack_scores(path.read_bytes() if path.is_file() else b"").items():
                if of_protocol == name:
                    combine(rules, {"a": score}, with_intervals=False)

        return read

    return make


TARGETS = tuple(Target(f"counts {name}", _kept_counts(name), ("counts.npz",)) for name in KEPT_COUNTS)
