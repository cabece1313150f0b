"""The complete profile ``paper`` on tiny models with random weights: rooms, real recordings, no models at all."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tiny_models import blocks, frame_of, paper_words, write_models

from su3d_bench.cli.main import main
from su3d_bench.core import registry
from su3d_bench.core.errors import ModelMissing
from su3d_bench.core.files.atomic import read_json
from su3d_bench.core.maps import Instances
from su3d_bench.core.system.timing import Timer
from su3d_bench.core.types import PerceptionNeeds, SceneInfo
from su3d_bench.perception import paper as profile_paper
from su3d_bench.perception.models.config import PaperConfig
from su3d_bench.perception.profiles import Perception, PerceptionConfig, build_perception, check_models, resolve_profile
from su3d_bench.store.predictions import read_prediction

SCENE = SceneInfo("rgbd", "wall", 1, 1, "camera")
# Random weights give low scores, so the thresholds are low.
OPEN: dict[str, Any] = {
    "grounded": {"boxes": {"box_threshold": 0.3, "text_threshold": 0.3}},
    "automatic": {
        "points_per_side": 3,
        "pred_iou_thresh": 0.0,
        "stability_score_thresh": 0.0,
        "box_nms_thresh": 1.0,
        "min_mask_region_area": 30,
    },
    "n_tags": 6,
}


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_models(tmp_path_factory.mktemp("models"))


def config_of(models: Path, **paper: Any) -> PerceptionConfig:
    content = {"models": {"folder": models, "encoder": "embedded"}, "paper": {**OPEN, **paper}}
    return PerceptionConfig.model_validate(content)


def built(config: PerceptionConfig, cache: Path, profile: str = "paper") -> Perception:
    return build_perception(profile, config, scene=SCENE, cache_root=cache, mesh=None)


@pytest.fixture
def no_models(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A machine without models."""
    for name in ("SU3D_MODELS", "HF_HUB_CACHE", "HF_HOME"):
        monkeypatch.setenv(name, str(tmp_path / "none"))
    return tmp_path


FRAME = frame_of(blocks(96, 128))


def test_named_regions_have_features_of_their_crops(models: Path, tmp_path: Path) -> None:
    needs = PerceptionNeeds(crop_ratios=(0.8, 1.0, 1.2), name_features=True)
    perception = built(config_of(models), tmp_path)
    found = perception.detect(FRAME, needs, Timer())
    n = len(found)
    assert n > 1 and perception.profile == "paper"
    assert found.masks.shape == (n, 96, 128) and found.masks.any(axis=(1, 2)).all()
    assert found.crop_features.shape == (n, 3, perception.encoder.dim)
    assert found.name_features is not None and found.name_features.shape == (n, perception.encoder.dim)
    assert found.captions == tuple(f"{'an' if name[0] in 'aeiou' else 'a'} {name} in a scene" for name in found.names)
    assert (np.diff(found.scores) <= 0).all() and found.scores.max() <= 1
    assert found.score_scale == "published"
    # Boxes of the masks, as in the paper's crops.
    rows = [np.flatnonzero(mask.any(axis=1)) for mask in found.masks]
    np.testing.assert_array_equal(found.boxes[:, [1, 3]], [[row[0], row[-1] + 1] for row in rows])


@pytest.mark.parametrize(
    ("method", "asked"),
    [
        ("conceptfusion-sam", {"points_per_side": 8, "pred_iou_thresh": 0.92, "crop_n_layers": 1,
                               "crop_n_points_downscale_factor": 2}),
        ("conceptgraphs", {"points_per_side": 12, "points_per_batch": 144, "min_mask_region_area": 100}),
        ("sam3d", {"points_per_side": 32, "pred_iou_thresh": 0.88, "stability_score_thresh": 0.95}),
        ("conceptgraphs-detector", {"region_boxes": "detector", "ram_resample": "bicubic",
                                    "boxes": {"box_threshold": 0.2, "text_threshold": 0.2, "nms_iou": 0.5,
                                              "names": "first-word"}}),
        ("conceptfusion", {"region_boxes": "mask", "boxes": {"box_threshold": 0.25, "text_threshold": 0.25}}),
        ("opensu3d", {"region_boxes": "mask",
                      "boxes": {"box_threshold": 0.25, "text_threshold": 0.25, "nms_iou": 0.4}}),
    ],
)  # fmt: skip
def test_published_mask_settings_of_each_method_reach_the_models(
    models: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str, asked: dict[str, Any]
) -> None:
    class Asked(Exception):
        pass

    class Telling:
        name = digest = "telling"

        def __init__(self, networks: Any, settings: Any) -> None:
            self.settings = settings.model_dump()

        def segment(self, frame: Any) -> Any:
            raise Asked(self.settings)

    for segmenter in ("GroundedSam", "AutomaticSam"):
        monkeypatch.setattr(profile_paper, segmenter, Telling)
    method_class = registry.load("method", method)
    published = PerceptionConfig.model_validate({"models": {"folder": models, "encoder": "embedded"}})
    with pytest.raises(Asked) as caught:
        built(published, tmp_path).detect(FRAME, method_class(method_class.Config()).needs, Timer())
    found = caught.value.args[0]
    inner = asked.pop("boxes", {})
    assert {key: found[key] for key in asked} == asked
    assert {key: found["boxes"][key] for key in inner} == inner


def test_same_frame_gives_the_same_bytes_from_models_and_cache(models: Path, tmp_path: Path) -> None:
    config, needs = config_of(models), PerceptionNeeds()
    uncached = config.model_copy(update={"cache": False})
    answers = [built(one, tmp_path).detect(FRAME, needs, Timer()) for one in (uncached, uncached, config, config)]
    for answer in answers[1:]:
        for name in ("masks", "boxes", "scores", "crop_features", "global_feature"):
            assert getattr(answer, name).tobytes() == getattr(answers[0], name).tobytes(), name
        assert answer.names == answers[0].names


def test_profile_reports_exactly_the_deviations_from_the_paper() -> None:
    ram = SimpleNamespace(tagger=SimpleNamespace(caveat=None))
    encoder = SimpleNamespace(name="ViT-H-14/laion2b_s32b_b79k")  # as reported by the encoder itself
    captioner = SimpleNamespace(vision_model="gpt-4-vision-preview")
    assert profile_paper.paper_deviations(PaperConfig(), ram, encoder, captioner) == []  # type: ignore[arg-type]
    assert profile_paper.paper_deviations(PaperConfig(), ram, encoder, None) == [  # type: ignore[arg-type]
        "names and captions: the tagger's names and a template replace the paper's vision model"
    ]
    other = PaperConfig.model_validate(
        {"segmenter": "sam-vit-b", "grounded": {"boxes": {"box_threshold": 0.3}, "stop_words": ["room"]}}
    )
    encoder.name, captioner.vision_model = "ViT-L-14/openai", "some-model"
    assert profile_paper.paper_deviations(other, ram, encoder, captioner) == [  # type: ignore[arg-type]
        "masks: sam-vit-b replaces the paper's sam-vit-h",
        "named masks: boxes.box_threshold, stop_words differ from OpenSU3D's settings",
        "features: ViT-L-14/openai replaces the paper's clip-vit-h-14",
        "names and captions: some-model replaces the paper's gpt-4-vision-preview",
    ]


def test_auto_selects_paper_on_camera_images_if_models_exist(models: Path, no_models: Path) -> None:
    here, away = config_of(models), config_of(no_models)
    assert resolve_profile("auto", "camera", here) == "paper"
    assert resolve_profile("auto", "rendered-rooms", here) == "embedded"
    assert resolve_profile("auto", "camera", away) == "embedded"
    assert resolve_profile("auto", "camera") == "embedded"
    caveat = built(away, no_models, "auto").caveat
    assert caveat is not None and "rendered homes only" in caveat


def test_missing_requested_tagger_fails_before_any_frame(models: Path, no_models: Path) -> None:
    check_models("paper", config_of(models))
    with pytest.raises(ModelMissing, match=r"model 'ram-plus': not found .*run: python tools/export_onnx\.py ram-plus"):
        check_models("paper", config_of(models, tagger="ram-onnx"))
    other = PerceptionConfig.model_validate({"models": {"folder": no_models, "encoder": "clip-vit-b-32"}})
    with pytest.raises(ModelMissing, match="model 'clip-vit-b-32': not found"):
        check_models("embedded", other)
    check_models("embedded", PerceptionConfig())


def test_room_runs_end_to_end(models: Path, tmp_path: Path, rooms_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SU3D_DATA", str(rooms_data))
    monkeypatch.setenv("SU3D_CACHE", str(tmp_path / "cache"))
    methods = ("opensu3d", "sam3d")  # named masks, and masks of everything
    assert main(paper_words(models, tmp_path / "out", "rooms/bathroom0", (), "--methods", *methods)) == 0
    for method in methods:
        found = read_prediction(next((tmp_path / "out").glob(f"scenes/*/{method}/prediction.npz")))
        assert isinstance(found, Instances) and len(found) > 0
        record = read_json(next((tmp_path / "out").glob(f"scenes/*/{method}/done.json")))
        assert {"packages.torch", "packages.transformers"} <= record["steps"]["predict"]["key"].keys()
    assert "RAM++ is not installed" in str(read_json(tmp_path / "out" / "metrics.json"))
