"""Whether an object is found by each of its texts: by hand, over a map, and with chains generated from ground truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scored_room import ENCODER, ID, instances, nothing, room, truth_as_prediction

from su3d_bench.core.types import GroundTruth
from su3d_bench.metrics.open_vocabulary.score import QueryTruth
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.questions.grounding import TAGS, ChainedText, Place, judge_chains
from su3d_bench.metrics.scoring import combine, pack_scores, plain_json, score_scene, unpack_scores
from su3d_bench.questions.chains import chain_truth, chains_of
from su3d_bench.questions.generator import generate
from su3d_bench.questions.model import new_question
from su3d_bench.questions.query_files import query_truth
from su3d_bench.questions.scene_map import known_objects

RULES = load_protocol("beacon3d")
TRUTH = room()
PERFECT = truth_as_prediction(TRUTH, with_labels=False)
CLASS, LOOK, WHERE = frozenset(("class",)), frozenset(("class", "appearance")), frozenset(("class", "spatial"))
# Objects 2 and 3 are chairs, of which the first is ranked first; 5 is the lamp, found by any text that names it.
CHAIR = ChainedText("chair", (2, 3), tags=CLASS, places=tuple(Place(0, k, 1) for k in range(3)))
LEFT = tuple(ChainedText(f"chair {k} of the left", (2,), tags=WHERE, places=(Place(0, k, 0),)) for k in range(3))
RIGHT = tuple(replace(one, object_ids=(3,)) for one in LEFT)
LAMP = tuple(ChainedText(f"white lamp {k}", (5,), tags=LOOK, places=(Place(1, k, 0),)) for k in range(3))


def values(prediction: object, *cases: ChainedText) -> dict[str, float | None]:
    score = score_scene(RULES, query_truth(TRUTH, cases, "here"), prediction, ENCODER)  # type: ignore[arg-type]
    kept = unpack_scores(pack_scores({RULES.name: score}))[RULES.name]
    found: dict[str, float | None] = plain_json(combine(RULES, {"a": kept}).metrics)
    return found


def test_object_is_right_if_all_its_finest_texts_are() -> None:
    found = values(PERFECT, *LEFT, CHAIR, *LAMP)
    assert [found[name] for name in ("case", "object", "chain", "class", "spatial")] == [1.0] * 5
    assert (found["n_case"], found["n_object"], found["n_chain"], found["geometry"]) == (7, 2, 6, None)
    missed = values(PERFECT, *RIGHT, CHAIR, *LAMP)  # the texts describe the chair that is ranked second
    assert (missed["object"], missed["case"], missed["spatial"]) == (0.5, 4 / 7, 0.0)
    assert (missed["chain"], missed["coarse alone"], missed["fine alone"], missed["neither"]) == (0.5, 0.5, 0.0, 0.0)
    one = values(PERFECT, LEFT[0], LEFT[1], RIGHT[2], CHAIR)
    assert one["object"] == 0.0 and one["chain"] == pytest.approx(2 / 3)


def test_four_kinds_of_chains_cover_all_chains() -> None:
    generator = np.random.default_rng(0)
    cases = (*LEFT, CHAIR, *LAMP)
    for _ in range(20):
        rows = judge_chains(cases, generator.random(len(cases)) < 0.5)
        sorts = np.stack([rows[name] for name in ("chain", "coarse alone", "fine alone", "neither")])
        assert (sorts.sum(axis=0) == 1).all() and set(TAGS) < set(rows)


def test_empty_map_finds_nothing_and_wrong_object_is_wrong() -> None:
    assert values(nothing(TRUTH), *LAMP)["object"] == 0.0
    assert PERFECT.features is not None
    elsewhere = instances(TRUTH.points, [np.flatnonzero(TRUTH.instance == 4)], None, PERFECT.features[4:5])
    assert values(elsewhere, *LAMP)["case"] == 0.0


def scene() -> GroundTruth:
    """A table with a lamp, a book and a vase on it, and objects next to it."""
    corners = [("lamp", (0, 0, 0), (0.5, 0.5, 1.8)), ("lamp", (3.2, 3.2, 0.8), (0.2, 0.2, 0.4)),
               ("table", (3, 3, 0), (0.9, 0.9, 0.8)), ("chair", (4.1, 3.2, 0), (0.5, 0.5, 0.9)),
               ("book", (3.6, 3.6, 0.8), (0.2, 0.15, 0.05)), ("backpack", (1, 4, 0), (0.4, 0.3, 0.5)),
               ("vase", (3.6, 3.1, 0.8), (0.2, 0.2, 0.4)), ("cushion", (5, 0, 0), (0.5, 0.5, 0.2))]  # fmt: skip
    rng = np.random.default_rng(1)
    points = np.concatenate([np.array(low) + rng.random((200, 3)) * size for _, low, size in corners])
    semantic = np.repeat([ID[name] for name, _, _ in corners], 200).astype(np.int32)
    owner = np.repeat(np.arange(len(corners)) + 1, 200).astype(np.int32)
    return GroundTruth(points.astype(np.float32), semantic, owner, TRUTH.labels, "mesh-vertices", "made")


def test_generated_chains_describe_only_their_object_and_begin_with_its_name() -> None:
    truth = scene()
    objects = known_objects(truth, 100)
    made = chain_truth("made/a", truth, objects)
    assert isinstance(made, QueryTruth) and (made.space, made.variant) == ("replica", "mesh-vertices")
    cases = chains_of(generate("made/a", objects, both=True), objects)
    assert made.queries == cases and {case.text for case in cases if case.tags == CLASS} == {"table"}
    n_objects = len({place.object for case in cases for place in case.places})
    for case in cases:
        for place in case.places:
            if place.step == 0:
                assert len(case.object_ids) == 1 and case.tags > CLASS
            else:
                assert case.tags == CLASS
    places = [place for case in cases for place in case.places]
    assert len(places) == len(set(places)) == 2 * 3 * n_objects
    few = chains_of(generate("made/a", objects, both=True), objects, 1)
    assert {place.object for case in few for place in case.places} == {0}


def test_object_with_fewer_than_three_unique_texts_is_not_asked_for() -> None:
    objects = known_objects(scene(), 100)
    name = objects.by_id(1).name
    asked = [new_question("a/b", "instance", name, (1, 2), "")]
    asked += [new_question("a/b", "property", f"{word} {name}", (1,), "") for word in ("red", "large")]
    assert chains_of(asked, objects) == ()
    asked.append(new_question("a/b", "relative by name", f"{name} on a table", (1,), ""))
    tags = {case.text.partition(" ")[0]: sorted(case.tags - CLASS) for case in chains_of(asked, objects)}
    assert (tags["red"], tags["large"], len(tags)) == (["appearance"], ["geometry"], 3)
    assert chains_of(asked[1:], objects) == ()  # nothing coarser
