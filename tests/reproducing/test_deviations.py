"""Each difference from the paper is reported by exactly its own line; a run as in the paper has none."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.perception.language.captioner import REFINE_FORM
from su3d_bench.perception.models.masks.grounded_sam import WORDS_CAVEAT
from su3d_bench.reports.tables.paper import PAPER_SCENES
from su3d_bench.reproducing.deviations import DEFAULTS, TABLE, Facts, deviations

OPENMASK3D, ANNOTATION = load_protocol("replica-openmask3d"), load_protocol("replica-annotation")
AS_PRINTED = OPENMASK3D.model_copy(
    update={
        "prompt": "an {} in a scene",
        "thresholds": (0.5, 0.95, 0.25),
        "transfer": OPENMASK3D.transfer.model_copy(update={"evaluation_voxel_m": 0.0025}),
    }
)
PAPER_MODEL = "the model gpt-4-1106-preview of the refiner, names of 5 views"
# The paper's own values where the defaults are others.
PAPERS: dict[str, Any] = {
    "method.depth_max": 1e4,
    "method.frame_voxel": 0.0,
    "method.overlap_rule": "as-printed",
    "perception.paper.captions": "model",
    "perception.paper.grounded.region_boxes": "detector",
    "perception.language.vision_model": "gpt-4-vision-preview",
    "perception.language.temperature": 0.0,
    "limit": 0,
}
FACTS = Facts(
    settings=PAPERS,
    profile="paper",
    encoder="ViT-H-14/laion2b_s32b_b79k",
    scenes=tuple(f"replica/{name}" for name in PAPER_SCENES["replica"]),
    protocols=(AS_PRINTED,),
    sizes={"replica": (1200, 680)},
)
# The paper states a prompt, and the reply must be parsed: a difference of every run with a language model.
ALWAYS = {("prompts of language models", "captions: the reply is requested as JSON too")}


def found(facts: Facts) -> set[tuple[str, str]]:
    return {(one.name, one.here) for one in deviations(facts)} - ALWAYS


def with_settings(**changes: Any) -> Facts:
    return replace(FACTS, settings={**PAPERS, **{name.replace("__", "."): value for name, value in changes.items()}})


def with_rules(**changes: Any) -> Facts:
    return replace(FACTS, protocols=(AS_PRINTED.model_copy(update=changes),))


def with_remarks(*remarks: str, **changes: Any) -> Facts:
    return replace(FACTS, remarks=tuple(f"replica/room0: {line}" for line in remarks), **changes)


def test_run_as_in_the_paper_has_no_other_line() -> None:
    assert {(one.name, one.here) for one in deviations(FACTS)} == ALWAYS
    varied = replace(with_settings(method__top_m=1), varied=frozenset({"method.top_m"}))
    assert found(varied) == set(), "a row of the paper's ablation"


CASES: dict[str, tuple[Facts, str]] = {
    "scenes": (replace(FACTS, scenes=("replica/room0", "replica/den")), "1 of the paper's 8, 1 others"),
    "frames": (with_settings(limit=5), "the first 5 updates of each scene"),
    "stride": (with_settings(method__stride=20), "20"),
    "image size": (replace(FACTS, sizes={"scannet": (1200, 900)}), "1200x900 (scannet)"),
    "tagger": (replace(FACTS, caveat=WORDS_CAVEAT), "the most likely words of a list, by the encoder"),
    "segmenter": (with_settings(perception__paper__segmenter="sam-vit-b"), '"sam-vit-b"'),
    "box threshold": (with_settings(perception__paper__grounded__boxes__box_threshold=0.3), "0.3"),
    "text threshold": (with_settings(perception__paper__grounded__boxes__text_threshold=0.2), "0.2"),
    "IoU threshold of boxes": (with_settings(perception__paper__grounded__boxes__nms_iou=0.5), "0.5"),
    "crops": (
        with_settings(perception__paper__grounded__region_boxes="mask"),
        "of the boxes of SAM's masks instead of GroundingDINO's",
    ),
    "encoder": (replace(FACTS, encoder="ViT-B-32/openai"), "ViT-B-32/openai"),
    "names and captions": (with_settings(perception__language__vision_model="gpt-6-luna"), "gpt-6-luna"),
    "temperature": (replace(FACTS, dropped=frozenset({"temperature"})), "not accepted by the model"),
    "temperature 0": (with_settings(perception__language__temperature=0.5), "0.5"),
    "border": (replace(FACTS, sizes={"rooms": (640, 480)}), "11 px in images 640 px wide (rooms)"),
    "background": (with_settings(method__background_names=("wall",)), '["wall"]'),
    "largest box": (with_settings(method__max_box_fraction=0.9), "a fraction of 0.9"),
    "fusion scheme": (with_settings(method__scheme="scheme4"), '"scheme4"'),
    "views": (with_settings(method__top_m=3), "3"),
    "depth": (with_settings(method__depth_max=10.0), "pixels up to 10.0 m"),
    "frame cloud": (with_settings(method__frame_voxel=None), "one point per voxel of the distance for matches"),
    "distance for matches": (with_settings(method__eps=0.05), "0.05 m"),
    "overlap ratio": (with_settings(method__overlap_rule="smaller-segment"), 'rule "smaller-segment"'),
    "overlap threshold": (with_settings(method__overlap_threshold=0.5), "0.5"),
    "DBSCAN epsilon": (with_settings(method__dbscan_eps=0.2), "0.2 m"),
    "DBSCAN cluster size": (with_settings(method__dbscan_min_points=10), "10"),
    "split": (with_settings(method__split_fraction=0.5), "a fraction of 0.5"),
    "reasoning": (with_remarks("answers by the built-in solver"), "the built-in solver"),
    "judges": (replace(FACTS, protocols=(ANNOTATION,)), "the ground truth (replica-annotation)"),
    "prompt of classes": (with_rules(prompt="an image of {}"), "'an image of {}' (replica-openmask3d)"),
    "voxels of evaluation": (with_rules(transfer=OPENMASK3D.transfer), "0.025 m (replica-openmask3d)"),
    "thresholds of AP": (with_rules(thresholds=OPENMASK3D.thresholds), "0.5 to 0.9 (replica-openmask3d)"),
    "other settings": (with_settings(method__density="all"), 'density = "all"'),
}


@pytest.mark.parametrize("name", CASES)
def test_each_difference_is_exactly_one_line(name: str) -> None:
    facts, here = CASES[name]
    assert found(facts) == {(name.removesuffix(" 0"), here)}


# Differences that come with others.
TOGETHER: dict[str, tuple[Facts, set[tuple[str, str]]]] = {
    "masks": (
        replace(FACTS, profile="embedded"),
        {
            ("masks", "those of the profile 'embedded'"),
            ("names and captions", "names by the encoder, captions by a template"),
        },
    ),
    "captions by a template": (
        with_settings(perception__paper__captions="template"),
        {("names and captions", "names by the tagger, captions by a template")},
    ),
    "label n'": (
        with_remarks("n': a vote over the names of 5 views, no language model"),
        {
            ("label n'", "a vote over the names of 5 views, no language model"),
            ("filter of labels n'", "boxes over 95 % of the map from above"),
        },
    ),
    "filter of labels n'": (
        with_remarks(f"n': {PAPER_MODEL}"),
        {
            ("filter of labels n'", "boxes over 95 % of the map from above"),
            ("prompts of language models", f"label n': followed by '{REFINE_FORM}'"),
        },
    ),
    "prompts of language models": (
        with_remarks("answers by the language model gpt-4-1106-preview"),
        {("prompts of language models", "reasoning: with the form of list and answer")},
    ),
    "questions": (
        replace(FACTS, protocols=(load_protocol("replica-retrieval"),)),
        {("judges", "the ground truth (replica-retrieval)"), ("questions", "generated (replica-retrieval)")},
    ),
    "evaluated points": (
        replace(FACTS, protocols=(AS_PRINTED.model_copy(update={"name": "replica-mesh-ex6"}),)),
        {("evaluated points", "vertices of the annotated mesh")},
    ),
}


@pytest.mark.parametrize("name", TOGETHER)
def test_differences_that_belong_together_are_all_reported(name: str) -> None:
    facts, lines = TOGETHER[name]
    assert found(facts) == lines


def test_every_row_of_the_table_is_tested_and_names_a_setting_that_exists() -> None:
    assert {row["name"] for row in TABLE} <= {*CASES, *TOGETHER}
    assert {row["setting"] for row in TABLE if "setting" in row} <= {*DEFAULTS, "limit"}
