"""Tiny networks in the published files: each is read as the published one, works, and is called what it is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tiny_models import blocks, frame_of, needs_models

from su3d_bench.core.errors import ConfigError, DataError
from su3d_bench.core.system.timing import Timer
from su3d_bench.core.types import PerceptionNeeds, SceneInfo
from su3d_bench.fetching.bringing import plan_models
from su3d_bench.fetching.sources import load_sources
from su3d_bench.perception.models.catalogue import STAND_IN, WEIGHTS_CAVEAT, encoder_known_as, model_entry
from su3d_bench.perception.models.files import ModelFiles, locate
from su3d_bench.perception.models.stand_ins.folder import STAND_INS, write_stand_ins
from su3d_bench.perception.profiles import PerceptionConfig, build_perception

pytestmark = needs_models


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_stand_ins(tmp_path_factory.mktemp("stand-ins"))


def test_there_is_one_for_every_model_that_is_fetched_for_the_papers(models: Path, tmp_path: Path) -> None:
    wanted = [one.source.name for one in plan_models(load_sources(None, ()), (), "paper", tmp_path)]
    assert set(wanted) == set(STAND_INS)
    assert all(locate(name, folder=models).is_stand_in for name in STAND_INS)
    assert locate("sam-vit-h", folder=models).weights.name == "sam_vit_h_4b8939.pth"
    with pytest.raises(ConfigError, match="no tiny network stands in for it"):
        write_stand_ins(tmp_path, "clip-vit-b-32")


def test_weights_of_the_published_size_are_no_stand_in_and_those_of_a_twentieth_are(tmp_path: Path) -> None:
    entry = model_entry("sam-vit-b")
    form = entry.form("original")
    weights = tmp_path / form.files[0]
    for n_mb, expected in ((form.size_mb, False), (form.size_mb // 4, False), (form.size_mb // 20, True)):
        with weights.open("wb") as file:
            file.truncate(n_mb * 10**6)  # takes no room on the disk
        assert ModelFiles(entry, form, tmp_path, weights).is_stand_in is expected


def test_the_whole_profile_runs_at_its_own_thresholds_and_says_whose_weights_it_has(
    models: Path, tmp_path: Path
) -> None:
    config = PerceptionConfig.model_validate({"models": {"folder": models}})
    scene = SceneInfo("rgbd", "wall", 1, 1, "camera")
    perception = build_perception("paper", config, scene=scene, cache_root=tmp_path, mesh=None)
    assert perception.caveat is not None
    assert perception.caveat.startswith(f"{WEIGHTS_CAVEAT} sam-vit-h, grounding-dino, ram-plus; ")
    assert "RAM++ is not here" not in perception.caveat and "features: " not in perception.caveat
    assert perception.encoder.name == f"ViT-H-14/laion2b_s32b_b79k{STAND_IN}"
    assert encoder_known_as(perception.encoder.name) is model_entry("clip-vit-h-14")
    frame = frame_of(blocks(96, 128, cell=24))
    named = perception.detect(frame, PerceptionNeeds(), Timer())
    assert len(named) >= 2 and np.isfinite(named.crop_features).all()
    for automatic in ("sam", "conceptgraphs", "conceptfusion"):
        found = perception.detect(frame, PerceptionNeeds(masks="class-agnostic", automatic=automatic), Timer())
        assert len(found) >= 4, automatic


def test_a_mask_is_what_its_box_holds(models: Path) -> None:
    from su3d_bench.perception.models.masks.sam import Sam
    from su3d_bench.perception.models.pretrained import load_sam

    sam = Sam(load_sam(locate("sam-vit-h", folder=models), "cpu", "float32"))
    image = sam.look(blocks(96, 128, cell=24))
    boxes = np.array([[10, 12, 60, 50], [64, 32, 120, 90], [0, 0, 128, 96]], np.float32)
    masks, scores = sam.from_boxes(image, boxes, is_single=False)
    for mask, (x0, y0, x1, y1) in zip(masks, boxes.astype(int), strict=True):
        inside = np.zeros_like(mask)
        inside[y0:y1, x0:x1] = True
        assert (mask & inside).sum() / (mask | inside).sum() > 0.6
    assert (scores > 0.7).all()


def test_a_small_checkpoint_that_lacks_tensors_is_one_line(models: Path, tmp_path: Path) -> None:
    import torch

    from su3d_bench.perception.models.files import read_weights
    from su3d_bench.perception.models.pretrained import load_sam

    published = locate("sam-vit-h", folder=models)
    tensors = read_weights(published.weights)
    for lost in ("image_encoder.pos_embed", "mask_decoder.iou_token.weight"):
        place = tmp_path / lost / "sam-vit-h" / published.weights.name
        place.parent.mkdir(parents=True)
        torch.save({name: tensor for name, tensor in tensors.items() if name != lost}, place)
        with pytest.raises(DataError, match="is no checkpoint of") as raised:
            load_sam(locate("sam-vit-h", folder=tmp_path / lost), "cpu", "float32")
        assert "\n" not in str(raised.value) and str(place) in str(raised.value)
