"""The profile ``paper`` as a whole on tiny models with random weights: rooms, real recordings, no models at all."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from places import REAL_RECORDINGS, needs_recordings
from tiny_models import blocks, frame_of, paper_words, write_models

from su3d_bench.cli.main import main
from su3d_bench.core import registry
from su3d_bench.core.config import write_toml
from su3d_bench.core.errors import ConfigError, ModelMissing
from su3d_bench.core.files.atomic import read_json
from su3d_bench.core.maps import Instances
from su3d_bench.core.system.timing import Timer
from su3d_bench.core.types import PerceptionNeeds, SceneInfo, UInt8Array
from su3d_bench.perception import paper as profile_paper
from su3d_bench.perception.cache import FrameCache
from su3d_bench.perception.language.captioner import CropCaption
from su3d_bench.perception.models.catalogue import WEIGHTS_CAVEAT
from su3d_bench.perception.models.config import PaperConfig
from su3d_bench.perception.models.masks.tagging import WORDS_CAVEAT
from su3d_bench.perception.models.stand_ins.detector import tiny_dino
from su3d_bench.perception.models.stand_ins.segmenter import tiny_sam
from su3d_bench.perception.profiles import Perception, PerceptionConfig, build_perception, check_models, resolve_profile
from su3d_bench.store.predictions import read_prediction

SCENE = SceneInfo("rgbd", "wall", 1, 1, "camera")
# Random weights are sure of nothing, so little is asked of them.
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


def test_named_regions_come_with_features_of_their_crops(models: Path, tmp_path: Path) -> None:
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
    # Boxes of the masks, as the paper's crops are.
    rows = [np.flatnonzero(mask.any(axis=1)) for mask in found.masks]
    np.testing.assert_array_equal(found.boxes[:, [1, 3]], [[row[0], row[-1] + 1] for row in rows])


def test_background_names_and_large_boxes_are_left_out(models: Path, tmp_path: Path) -> None:
    perception = built(config_of(models), tmp_path)
    everything = perception.detect(FRAME, PerceptionNeeds(), Timer())
    named = everything.names[0]
    fewer = perception.detect(FRAME, PerceptionNeeds(background_names=(named,)), Timer())
    assert set(fewer.names) == set(everything.names) - {named}
    areas = [(box[2] - box[0]) * (box[3] - box[1]) / (96 * 128) for box in everything.boxes]
    limit = float(np.median(areas))
    small = perception.detect(FRAME, PerceptionNeeds(max_box_fraction=limit), Timer())
    assert len(small) == sum(area <= limit for area in areas)


def test_every_region_is_an_item_where_none_is_named(models: Path, tmp_path: Path) -> None:
    perception = built(config_of(models), tmp_path)
    found = perception.detect(FRAME, PerceptionNeeds(masks="class-agnostic"), Timer())
    assert len(found) > 1
    assert set(found.names) == {"item"} and set(found.captions) == {"an item in a scene"}


def test_a_method_gets_the_settings_of_its_own_program(models: Path, tmp_path: Path) -> None:
    perception = built(config_of(models), tmp_path)
    strict = perception.detect(FRAME, PerceptionNeeds(masks="class-agnostic", automatic="conceptgraphs"), Timer())
    assert len(strict) == 0, "random masks are not stable"
    tags = perception.detect(FRAME, PerceptionNeeds(grounding="conceptgraphs"), Timer())
    known = {"other item", "wall", "floor", "ceiling", *config_words()}
    assert set(tags.names) <= known
    whole = perception.detect(FRAME, PerceptionNeeds(grounding="conceptgraphs-whole-tags"), Timer())
    assert len(whole) <= len(tags) and set(whole.names) <= known
    with pytest.raises(ConfigError, match=r"class-agnostic masks 'conceptgraph', there are none; did you mean"):
        perception.detect(FRAME, PerceptionNeeds(masks="class-agnostic", automatic="conceptgraph"), Timer())


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
def test_each_methods_published_mask_settings_reach_the_models(
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


def config_words() -> tuple[str, ...]:
    from su3d_bench.perception.embedded.naming import vocabulary

    return vocabulary()


def test_the_same_frame_gives_the_same_bytes_from_models_and_from_the_cache(models: Path, tmp_path: Path) -> None:
    config, needs = config_of(models), PerceptionNeeds()
    uncached = config.model_copy(update={"cache": False})
    answers = [built(one, tmp_path).detect(FRAME, needs, Timer()) for one in (uncached, uncached, config, config)]
    for answer in answers[1:]:
        for name in ("masks", "boxes", "scores", "crop_features", "global_feature"):
            assert getattr(answer, name).tobytes() == getattr(answers[0], name).tobytes(), name
        assert answer.names == answers[0].names


def test_a_cached_frame_needs_no_network(models: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = config_of(models)
    first = built(config, tmp_path).detect(FRAME, PerceptionNeeds(), Timer())
    from su3d_bench.perception.models import front_end

    def refuse(*_: Any) -> Any:
        raise AssertionError("a network was loaded")

    monkeypatch.setattr(front_end, "load_sam", refuse)
    monkeypatch.setattr(front_end, "load_grounding_dino", refuse)
    again = built(config, tmp_path).detect(FRAME, PerceptionNeeds(), Timer())
    assert again.masks.tobytes() == first.masks.tobytes()


def test_what_moves_the_answer_moves_the_digest(models: Path, tmp_path: Path) -> None:
    digests = [
        built(config, tmp_path).digest
        for config in (
            config_of(models),
            config_of(models),
            config_of(models, n_tags=7),
            config_of(models, grounded={"masks": "single"}),
            config_of(models, automatic={"points_per_side": 4}),
        )
    ]
    assert digests[0] == digests[1]
    assert len(set(digests)) == 4


def test_stand_ins_for_ram_are_said_beside_every_number(models: Path, tmp_path: Path) -> None:
    caveat = built(config_of(models), tmp_path).caveat
    assert caveat is not None
    assert caveat.split("; ")[:2] == [f"{WEIGHTS_CAVEAT} sam-vit-h, grounding-dino", WORDS_CAVEAT.split("; ")[0]]


def test_the_profile_says_what_it_computes_otherwise_than_the_paper_and_nothing_else() -> None:
    ram = SimpleNamespace(tagger=SimpleNamespace(caveat=None), stand_ins=())
    encoder = SimpleNamespace(name="ViT-H-14/laion2b_s32b_b79k")  # as the encoder itself says
    captioner = SimpleNamespace(vision_model="gpt-4-vision-preview")
    assert profile_paper.stand_ins(PaperConfig(), ram, encoder, captioner) == []  # type: ignore[arg-type]
    assert profile_paper.stand_ins(PaperConfig(), ram, encoder, None) == [  # type: ignore[arg-type]
        "names and captions: the tagger's names and a template stand in for the paper's vision model"
    ]
    other = PaperConfig.model_validate(
        {"segmenter": "sam-vit-b", "grounded": {"boxes": {"box_threshold": 0.3}, "stop_words": ["room"]}}
    )
    encoder.name, captioner.vision_model = "ViT-L-14/openai", "some-model"
    assert profile_paper.stand_ins(other, ram, encoder, captioner) == [  # type: ignore[arg-type]
        "masks: sam-vit-b stands in for the paper's sam-vit-h",
        "named masks: boxes.box_threshold, stop_words set otherwise than OpenSU3D's",
        "features: ViT-L-14/openai stands in for the paper's clip-vit-h-14",
        "names and captions: some-model stands in for the paper's gpt-4-vision-preview",
    ]


def test_a_vision_model_gives_names_and_captions_where_it_is_asked_for(models: Path, tmp_path: Path) -> None:
    from su3d_bench.perception.models.front_end import load_networks
    from su3d_bench.perception.paper import PaperPerception

    class Describing:
        digest = vision_model = "describing"

        def captions(self, crops: list[UInt8Array], names: tuple[str, ...]) -> list[CropCaption]:
            return [
                CropCaption(f"{name} {crop.shape[1]} wide", "seen", "model", "", "")
                for crop, name in zip(crops, names, strict=True)
            ]

    config = config_of(models)
    plain = built(config, tmp_path)
    networks = load_networks(config.paper, config.models, plain.encoder)
    asked = PaperPerception(config.paper, networks, plain.encoder, FrameCache(None), Describing())  # type: ignore[arg-type]
    without, described = (one.detect(FRAME, PerceptionNeeds(), Timer()) for one in (plain, asked))
    widths = (without.boxes[:, 2] - without.boxes[:, 0]).astype(int)
    assert described.names == tuple(f"{name} {width} wide" for name, width in zip(without.names, widths, strict=True))
    assert set(described.captions) == {"seen"}
    assert asked.digest != plain.digest


def test_the_exported_segmenter_gives_the_regions_of_torch(models: Path, tmp_path: Path) -> None:
    words = ["models", "export", "sam-vit-h", "--out", str(tmp_path / "x"), "--quiet"]
    assert main([*words, "--set", f"perception.models.folder={models}"]) == 0
    content = config_of(models).model_dump()
    content["models"]["paths"] = {"sam-vit-h": tmp_path / "x"}
    content["paper"]["sam_runtime"] = "onnx"
    other = built(PerceptionConfig.model_validate(content), tmp_path)
    mine = built(config_of(models), tmp_path)
    assert other.digest != mine.digest
    a, b = (one.detect(FRAME, PerceptionNeeds(), Timer()) for one in (mine, other))
    assert a.names == b.names
    assert (a.masks != b.masks).mean() < 5e-3


def test_auto_is_paper_on_camera_images_where_the_models_are(models: Path, no_models: Path) -> None:
    here, away = config_of(models), config_of(no_models)
    assert resolve_profile("auto", "camera", here) == "paper"
    assert resolve_profile("auto", "rendered-rooms", here) == "embedded"
    assert resolve_profile("auto", "camera", away) == "embedded"
    assert resolve_profile("auto", "camera") == "embedded"
    caveat = built(away, no_models, "auto").caveat
    assert caveat is not None and "rendered rooms only" in caveat


def test_without_models_one_line_says_what_to_fetch(no_models: Path) -> None:
    with pytest.raises(ModelMissing) as caught:
        built(config_of(no_models), no_models)
    line = str(caught.value)
    assert "\n" not in line and "run: su3d-bench models fetch sam-vit-h" in line
    ram = PerceptionConfig.model_validate({"paper": {"tagger": "ram-onnx"}})
    assert ram.paper.tagger == "ram-onnx"


def test_the_command_line_says_it_too(no_models: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    monkeypatch.chdir(no_models)
    words = ["run", "--scenes", "rooms/living0", "--profile", "paper", "--limit", "1", "--out", "out", "--quiet"]
    assert main(words) == 2
    said = capsys.readouterr().err
    assert said.startswith("su3d-bench: model 'clip-vit-h-14': not found below") and len(said.splitlines()) == 1
    assert not (no_models / "out").exists(), "no frame was read"
    assert main([*words, "--set", "perception.models.encoder=embedded"]) == 2
    assert "run: su3d-bench models fetch sam-vit-h" in capsys.readouterr().err


def test_a_tagger_that_was_asked_for_is_looked_for_before_any_frame(models: Path, no_models: Path) -> None:
    check_models("paper", config_of(models))
    with pytest.raises(ModelMissing, match=r"model 'ram-plus': not found .*run: su3d-bench models export ram-plus"):
        check_models("paper", config_of(models, tagger="ram-onnx"))
    other = PerceptionConfig.model_validate({"models": {"folder": no_models, "encoder": "clip-vit-b-32"}})
    with pytest.raises(ModelMissing, match="model 'clip-vit-b-32': not found"):
        check_models("embedded", other)
    check_models("embedded", PerceptionConfig())


def test_a_room_runs_end_to_end(
    models: Path, tmp_path: Path, rooms_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SU3D_DATA", str(rooms_data))
    monkeypatch.setenv("SU3D_CACHE", str(tmp_path / "cache"))
    methods = ("opensu3d", "sam3d")  # named masks, and masks of everything
    assert main(paper_words(models, tmp_path / "out", "rooms/living0", (), "--methods", *methods)) == 0
    for method in methods:
        found = read_prediction(next((tmp_path / "out").glob(f"scenes/*/{method}/prediction.npz")))
        assert isinstance(found, Instances) and len(found) > 0
        sealed = read_json(next((tmp_path / "out").glob(f"scenes/*/{method}/done.json")))
        assert {"packages.torch", "packages.transformers"} <= sealed["steps"]["predict"]["key"].keys()
    assert "RAM++ is not here" in str(read_json(tmp_path / "out" / "metrics.json"))


@needs_recordings
def test_real_frames_run_end_to_end(models: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "data" / "rgbd" / "chair"
    folder.mkdir(parents=True)
    keys = {
        "folder": os.path.relpath(REAL_RECORDINGS.resolve() / "open3d_rgbd", folder),
        "colour": "color/{index}.jpg",
        "depth": "depth/{index}.png",
        "trajectory": "trajectory.log",
        "intrinsics_file": "camera_primesense.json",
        "depth_unit_m": 1e-3,
    }
    (folder / "rgbd.toml").write_text(write_toml([((key,), value, "") for key, value in keys.items()]))
    monkeypatch.setenv("SU3D_DATA", str(tmp_path / "data"))
    monkeypatch.setenv("SU3D_CACHE", str(tmp_path / "cache"))
    assert main(paper_words(models, tmp_path / "out", "rgbd/chair", (), "--stride", "1")) == 0
    found = read_prediction(next((tmp_path / "out").glob("scenes/*/opensu3d/prediction.npz")))
    assert isinstance(found, Instances) and len(found) > 0


@pytest.mark.parametrize("device", ["cuda"])
def test_the_networks_run_on_a_gpu(device: str) -> None:
    torch = pytest.importorskip("torch")
    if not torch.cuda.is_available():
        pytest.skip("needs a GPU that torch can use")
    import copy

    from su3d_bench.perception.models.masks.sam import Sam, TorchSam

    boxes = np.array([[5, 5, 60, 60], [0, 0, 128, 96]], np.float32)
    sams = [Sam(TorchSam(tiny_sam())), Sam(TorchSam(copy.deepcopy(tiny_sam()).to(device)))]
    masks = [sam.from_boxes(sam.look(FRAME.rgb), boxes, is_single=False)[0] for sam in sams]
    assert (masks[0] != masks[1]).mean() < 0.01
    assert copy.deepcopy(tiny_dino()).to(device, torch.float16).dtype == torch.float16
