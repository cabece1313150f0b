"""The catalogue of the homes: its size, the split between seen and held out, and that faulty models are refused."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from su3d_bench.core.errors import DataError
from su3d_bench.datasets.homes.catalogue import catalogue, held_out_of
from su3d_bench.datasets.homes.dataset import label_set
from su3d_bench.datasets.homes.model_builder import build_item
from su3d_bench.datasets.homes.model_format import read_models
from su3d_bench.metrics.protocols.loading import load_protocol

CLASSES = catalogue().classes
MODELS = [model for known in CLASSES.values() for model in known.models]


def test_catalogue_has_at_least_150_classes_and_250_models() -> None:
    assert len(CLASSES) >= 150
    assert len(MODELS) >= 250


def test_a_fifth_of_the_classes_is_novel_drawn_by_the_digest_of_their_names() -> None:
    free = [name for name, known in CLASSES.items() if not {"placed", "shell"} & set(known.row.where)]
    novel = [name for name, known in CLASSES.items() if known.is_novel]
    assert len(novel) == round(len(CLASSES) / 5)
    digests = {name: hashlib.sha256(name.encode()).hexdigest() for name in free}
    last = max(digests[name] for name in novel)
    # Those with a smaller digest that are not novel are needed by an arrangement.
    earlier = [name for name in free if digests[name] < last and name not in novel]
    assert set(earlier) <= NEEDED, set(earlier) - NEEDED


def test_a_third_of_the_models_of_each_base_class_is_held_out() -> None:
    for known in CLASSES.values():
        n, n_held_out = len(known.models), sum(model.is_held_out for model in known.models)
        assert n_held_out == (n if known.is_novel else 0 if n < 2 else -(-n // 3)), known.name
        assert not known.is_novel or not catalogue().models(known.name, training=True)
    assert held_out_of(["a", "b", "c", "d"]) == held_out_of(["d", "c", "b", "a"])


def test_scenes_for_training_have_only_seen_models_and_classes() -> None:
    from su3d_bench.datasets.homes.furnish import furnish

    plan = furnish(np.random.default_rng(3), catalogue(), training=True)
    held_out = {model.name for model in MODELS if model.is_held_out}
    used = {placed.item.model for placed in plan.placed}
    assert len(used) > 30
    assert not used & held_out
    assert not any(CLASSES[placed.item.class_name].is_novel for placed in plan.placed)


def test_protocol_and_label_set_have_the_classes_of_the_catalogue() -> None:
    rules = load_protocol("homes-instance")
    assert [(entry.id, entry.name, entry.group) for entry in rules.classes] == [
        (known.id, name, known.row.group) for name, known in CLASSES.items()
    ]
    assert label_set().names == tuple(CLASSES)


@pytest.mark.parametrize("known", CLASSES.values(), ids=list(CLASSES))
def test_models_build_and_their_spots_are_inside(known) -> None:  # type: ignore[no-untyped-def]
    for model in known.models:
        for seed in range(2):
            item = model.build(np.random.default_rng(seed), muted=bool(seed))
            corners = np.concatenate([part.shape.quads.reshape(-1, 3) for part in item.parts])
            assert np.isfinite(corners).all() and all(np.isfinite(part.shape.normals).all() for part in item.parts)
            assert abs(corners[:, 2].min()) < 1e-9 and np.allclose(np.ptp(corners, axis=0), item.size)
            assert item.size.min() > 0.004 and item.size.max() < 3.2, (model.name, item.size)
            assert item.class_name == known.name and item.model == model.name
            for spot in item.spots:
                assert spot.x0 < spot.x1 and spot.y0 < spot.y1, model.name
                assert -1e-6 <= spot.z <= item.size[2] + 1e-6, model.name
                reach = item.size[:2] / 2 + 0.01
                assert max(abs(spot.x0), abs(spot.x1)) < reach[0] and max(abs(spot.y0), abs(spot.y1)) < reach[1]


def test_equal_seeds_build_equal_items() -> None:
    one, other = (MODELS[40].build(np.random.default_rng(5)) for _ in range(2))
    assert all(
        np.array_equal(a.shape.quads, b.shape.quads) and a.material == b.material
        for a, b in zip(one.parts, other.parts, strict=True)
    )


def test_colour_and_mutedness_are_those_asked_for() -> None:
    row = next(model.row for model in MODELS if "red" in model.row.colours and "plastic" in model.row.made_of)
    bright, muted = (build_item(row, np.random.default_rng(1), flag, "red") for flag in (False, True))
    assert bright.colour == muted.colour == "red"
    spread = [max(np.ptp(part.material.a) for part in item.parts) for item in (bright, muted)]
    assert spread[1] < 0.6 * spread[0]


GOOD: dict[str, object] = {
    "name": "thing",
    "class": "box",
    "made_of": ["paper"],
    "colours": ["brown"],
    "parts": [{"block": [0.1, 0.1, 0.1]}],
}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"parts": []}, "at least 1"),
        ({"parts": [{"block": [0.1, 0.1, 0.1], "revolve": [[0, 0], [1, 1]]}]}, "exactly one of"),
        ({"parts": [{"block": [0.1, 0.1, float("inf")]}]}, "block"),
        ({"parts": [{"block": [0.1, 0.1, 0.1], "repeat": {"n": 100000}}]}, "n is 1 to 64"),
        ({"parts": [{"block": [0.1, 0.1, 0.1], "of": "moonrock grey"}]}, "does not begin with a material"),
        ({"made_of": ["moonrock"]}, "unknown material"),
        ({"colours": ["octarine"]}, "unknown colour"),
        ({"surprise": 1}, "surprise"),
    ],
)
def test_faulty_model_is_refused_with_its_name(change: dict[str, object], words: str, tmp_path: Path) -> None:
    path = tmp_path / "models.toml"
    path.write_text(_toml(GOOD | change))
    with pytest.raises(DataError, match="model 'thing'") as caught:
        read_models(path)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_good_model_is_read(tmp_path: Path) -> None:
    (tmp_path / "models.toml").write_text(_toml(GOOD))
    assert [row.name for row in read_models(tmp_path / "models.toml")] == ["thing"]


def _toml(row: dict[str, object]) -> str:
    return "[[model]]\n" + "".join(f"{key} = {_value(value)}\n" for key, value in row.items())


def _value(value: object) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_value(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(_value, value)) + "]"
    return "inf" if value == float("inf") else json.dumps(value)


NEEDED = {"dresser", "picture", "shelf"}  # on which or above which the groups of recipes.toml put things
