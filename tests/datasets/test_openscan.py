"""OpenScan's attributes: the file, words and classes, ground truth of a scan and of the built-in rooms."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scannet_scan import SCAN, dataset, write_floor_truth, write_scan

from su3d_bench.core.errors import GroundTruthMissing
from su3d_bench.datasets.openscan import KEYS, RAW_NAME, attribute_id, attribute_ids, label_set, read_attributes
from su3d_bench.datasets.scannet.dataset import ScanNet
from su3d_bench.metrics.compatibility import TruthFacts, truth_incompatibility
from su3d_bench.metrics.protocols.loading import load_protocol

# A record as in README.md of the release.
RECORD = {
    "scene_id": SCAN,
    "object_id": "0",
    "object_name": "chair",
    "material": "wood",
    "affordance": "sleep",
    "property": "soft",
    "type": "source of illumination",
    "manner": "steered by handlebars",
    "synonyms": "bedside table",
    "requirement": "water and sun",
    "element": "88 keys",
}
SENTENCES = {
    "openscan-material": "This term is made of wood",
    "openscan-affordance": "This term is used for sleep",
    "openscan-property": "This term is soft",
    "openscan-type": "This term is a source of illumination",
    "openscan-manner": "This term can be steered by handlebars",
    "openscan-synonym": "This term is related to bedside table",
    "openscan-requirement": "this term requires water and sun",
    "openscan-element": "This term has 88 keys",
}


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data root with one annotated scan, whose only object has id 0, and OpenScan's records of it."""
    root = tmp_path_factory.mktemp("openscan")
    write_floor_truth(write_scan(root, n_frames=1), spacing_m=0.5)
    write(root / RAW_NAME, [RECORD])
    return root


def write(path: Path, records: Any) -> Path:
    path.write_text(records if isinstance(records, str) else json.dumps(records))
    return path


def test_words_of_a_record_match_the_sentences_of_the_lists(tmp_path: Path) -> None:
    known = read_attributes(write(tmp_path / RAW_NAME, [RECORD]))[SCAN]
    for variant, sentence in SENTENCES.items():
        (class_id,) = attribute_ids(known, variant, "here").values()
        assert label_set(variant).name_of(class_id) == sentence
    assert set(SENTENCES) == set(KEYS)


def test_word_matches_the_shortest_sentence_ending_with_it() -> None:
    names = {word: attribute_id("openscan-type", word) for word in ("bag", "handbag", "toy animal", "toy_animal", "ag")}
    assert names == {"bag": 69, "handbag": 38, "toy animal": 70, "toy_animal": 70, "ag": None}
    assert [attribute_id("openscan-affordance", f"{blank}hang clothes") for blank in ("", "\u00a0")] == [79, 34]
    assert attribute_id("openscan-element", "keys") == 24 and attribute_id("openscan-element", "88 keys") == 26


def test_ground_truth_of_a_scan_has_the_attributes_of_its_objects(scan: Path) -> None:
    truth = dataset(scan).ground_truth(SCAN, "openscan-material")
    plain = dataset(scan).ground_truth(SCAN, "nyu40-vertices")
    assert (truth.labels, truth.variant) == (label_set("openscan-material"), "openscan-material")
    assert np.array_equal(truth.instance, plain.instance) and np.array_equal(truth.points, plain.points)
    assert set(truth.semantic[truth.instance == 1].tolist()) == {1} and not truth.semantic[truth.instance != 1].any()
    facts = TruthFacts.of_dataset(ScanNet)
    assert truth_incompatibility(load_protocol("openscan-material"), facts) is None
    assert truth_incompatibility(load_protocol("rooms-instance"), facts) is not None


def test_object_without_a_word_is_void(tmp_path: Path) -> None:
    words = read_attributes(write(tmp_path / RAW_NAME, [RECORD | {"material": "", "element": "other"}]))[SCAN]
    assert attribute_ids(words, "openscan-material", "here") == attribute_ids(words, "openscan-element", "x") == {0: 0}


def test_missing_file_or_scan_hints_how_to_get_it(scan: Path, tmp_path: Path) -> None:
    bare = dataset(tmp_path)
    write_floor_truth(write_scan(tmp_path, n_frames=1), spacing_m=0.5)
    with pytest.raises(GroundTruthMissing, match=rf"{RAW_NAME} is missing, get it by https://github.com/YoujunZhao"):
        bare.ground_truth(SCAN, "openscan-type")
    write(tmp_path / RAW_NAME, [RECORD | {"scene_id": "scene0001_00"}])
    with pytest.raises(GroundTruthMissing, match="has no record of this scan"):
        dataset(tmp_path).ground_truth(SCAN, "openscan-type")
    assert dataset(tmp_path).digest(SCAN) != dataset(scan).digest(SCAN)
