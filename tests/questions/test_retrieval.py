"""Instances of a map ranked by their similarity to a text."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from su3d_bench.core.errors import PredictionError
from su3d_bench.core.maps import DenseFeatures, Instances
from su3d_bench.core.types import Float32Array, Float64Array, UInt8Array
from su3d_bench.questions import model as questions_model
from su3d_bench.questions.model import rank, rank_all, retrieved_points
from su3d_bench.questions.refining import FilterConfig, exclusion_reasons


class TwoWords:
    """An encoder of two texts."""

    name = "two-words"
    digest = "0"
    dim = 2

    def encode_images(self, images: Sequence[UInt8Array]) -> Float32Array:
        return np.zeros((len(images), 2), np.float32)

    def encode_texts(self, texts: Sequence[str]) -> Float32Array:
        return np.array([[1, 0] if text == "east" else [0, 1] for text in texts], np.float32).reshape(-1, 2)


def instances_with(features: Float64Array | None) -> Instances:
    n = 0 if features is None else len(features)
    return Instances.of(np.zeros((n, 3), np.float32), [np.array([k]) for k in range(n)], features=features)


def test_retrieval_ranks_by_cosine_for_any_feature_length() -> None:
    found = instances_with(np.array([[0.1, 0.1], [9.0, 1.0], [0.0, 0.0], [0.5, 0.0]]))
    east, north = rank_all(found, ["east", "north"], TwoWords())
    assert east.order.tolist() == [3, 1, 0, 2]
    np.testing.assert_allclose(east.similarity, [np.sqrt(0.5), 9 / np.sqrt(82), 0, 1], atol=1e-7)
    assert north.order.tolist() == [0, 1, 2, 3]  # 2 and 3 are equal: the order of the map


def test_retrieval_without_comparable_features_is_rejected() -> None:
    with pytest.raises(PredictionError, match="no features"):
        rank(instances_with(None), "east", TwoWords())
    with pytest.raises(PredictionError, match="3 dimensions, encoder 'two-words' has 2"):
        rank(instances_with(np.ones((1, 3))), "east", TwoWords())


def as_the_program_of_conceptfusion_shows(similarity: Float64Array) -> list[int]:
    """The points kept by its examples/demo_text_query.py: similarity of at least 0.6 relative to the range."""
    similarity = (similarity + 1.0) / 2.0
    relative = (similarity - similarity.min()) / (similarity.max() - similarity.min() + 1e-12)
    return np.flatnonzero(relative >= 0.6).tolist()


@pytest.mark.parametrize("rows_at_once", [7, 65536])
def test_feature_only_retrieval_matches_original_program(rows_at_once: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(questions_model, "BLOCK_ROWS", rows_at_once)
    random = np.random.default_rng(3)
    features = random.normal(size=(60, 2)).astype(np.float16)
    features[::9] = 0  # without a feature they are ignored
    dense = DenseFeatures(random.normal(size=(60, 3)).astype(np.float32), features)
    has = np.flatnonzero(features.any(axis=1))
    found = retrieved_points(dense, ["east", "north"], TwoWords())
    for k in range(2):
        similarity = features[has, k].astype(np.float64) / np.linalg.norm(features[has].astype(np.float64), axis=1)
        assert found.mask(k).tolist() == has[as_the_program_of_conceptfusion_shows(similarity)].tolist()
    assert np.array_equal(found.points, dense.points)


def test_equal_similarities_retrieve_no_points() -> None:
    for n, features in ((0, np.zeros((0, 2))), (3, np.zeros((3, 2))), (3, np.ones((3, 2)))):
        dense = DenseFeatures(np.zeros((n, 3), np.float32), features.astype(np.float16))
        assert retrieved_points(dense, ["east"], TwoWords()).sizes.tolist() == [0]


def plan_of(*sides_m: tuple[float, float]) -> Instances:
    """Instances whose boxes have these sides from above, in a map of 10 m by 10 m with points of no instance."""
    clouds = [np.array([[0, 0, 0], [x, y, 1]], np.float32) for x, y in sides_m]
    corners = np.array([[0, 0, 0], [10, 10, 2]], np.float32)
    masks = [np.array([2 * k, 2 * k + 1]) for k in range(len(clouds))]
    return Instances.of(np.concatenate([*clouds, corners]), masks)


@pytest.mark.parametrize("name", ["walls", "Wall", "hardwood floor", "the ground"])
def test_background_names_are_excluded(name: str) -> None:
    assert exclusion_reasons(plan_of((1, 1)), (name,), FilterConfig()) == (f"'{name}' is background",)
    assert exclusion_reasons(plan_of((1, 1)), (name,), FilterConfig(background_names=())) == ("",)


@pytest.mark.parametrize("name", ["wall lamp", "floor mat", "ceiling fan", "wall-mounted shelf", "sofa", "", "<wall>x"])
def test_objects_on_walls_and_floors_are_retained(name: str) -> None:
    assert exclusion_reasons(plan_of((1, 1)), (name,), FilterConfig()) == ("",)


def test_box_that_covers_the_map_from_above_is_excluded() -> None:
    made = plan_of((9.8, 9.8), (9.7, 9.7), (1, 10))  # 96 %, 94 %, 10 %
    assert exclusion_reasons(made, ("rug",) * 3, FilterConfig()) == (
        "its box has 96 % of the map's area from above",
        "",
        "",
    )
    assert exclusion_reasons(made, ("rug",) * 3, FilterConfig(max_map_fraction=1.0)) == ("", "", "")
    assert exclusion_reasons(made, ("rug",) * 3, FilterConfig(max_map_fraction=0.05))[2] != ""
