"""Maps of OVO, RayFronts, ESAM and OnlineAnySeg: files saved by their own code are read to the last value.

``tests/cases/online_maps`` was saved by the originals' own functions on synthetic inputs: OVO at cf3b68e
(``VanillaMapper``, ``Instance3D``, ``save_dict_to_ckpt``; features in float32, float16 and bfloat16), RayFronts at
cfa0e6a (``save`` of three maps), ESAM at 188fc6d (``mask_to_color``), OnlineAnySeg at 152466e
(``export_instance_mask``); torch 2.13.0.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import prediction_files as made
import pytest
from places import CASES

from su3d_bench.core.maps import DenseFeatures, Instances, Partition
from su3d_bench.predictions.formats import READERS, recognise

FILES = CASES / "online_maps"
POINTS = np.random.default_rng(1).normal(size=(6, 3)).astype(np.float32)
ROW = np.ones(4, np.float32)


def expected() -> dict[str, Any]:
    with np.load(FILES / "expected.npz") as archive:
        return {name: archive[name] for name in archive.files}


def copied(tmp_path: Path, **names: str) -> Path:
    """A folder ``room0`` with the saved files, named as in a result."""
    folder = tmp_path / "room0"
    folder.mkdir()
    for name in names.values():
        shutil.copy(FILES / name, folder / name)
    return folder


def read(path: Path, scene: str = "room0") -> Any:
    return recognise(path).read(path, scene).content


# ---- files of the originals


def test_a_map_of_ovo_has_the_object_of_each_point_and_its_feature(tmp_path: Path) -> None:
    content, known = read(copied(tmp_path, map="ovo_map.ckpt")), expected()
    assert isinstance(content, Partition)
    np.testing.assert_array_equal(content.points, known["ovo_xyz"])
    np.testing.assert_array_equal(content.features, known["ovo_features"])
    numbers = np.append(known["ovo_numbers"], -1)
    np.testing.assert_array_equal(numbers[content.instance], known["ovo_ids"])


@pytest.mark.parametrize(("file", "name"), [("semantic_voxel_map.pt", "voxels"), ("semantic_point_cloud.pt", "points")])
def test_both_saved_rayfronts_maps_are_read_as_dense_features(tmp_path: Path, file: str, name: str) -> None:
    shutil.copy(FILES / file, tmp_path / "room0.pt")
    content, known = read(tmp_path), expected()
    assert isinstance(content, DenseFeatures)
    np.testing.assert_array_equal(content.points, known[f"{name}_xyz"])
    np.testing.assert_array_equal(content.features, known[f"{name}_feat"].astype(np.float16))


def test_onlineanyseg_masks_have_their_own_points_and_features(tmp_path: Path) -> None:
    folder, known = copied(tmp_path, masks="ckpt_final.npz"), expected()
    points = np.random.default_rng(0).normal(size=(30, 3))
    made.write_object(folder / "final.ply", points)
    content = read(folder)
    assert isinstance(content, Instances) and content.labels is None
    np.testing.assert_array_equal(content.points, points.astype(np.float32))
    np.testing.assert_array_equal(content.features, known["onlineanyseg_features"])
    for mask, members in zip(known["onlineanyseg_masks"], content.sets(), strict=True):
        np.testing.assert_array_equal(members, np.flatnonzero(mask))


def test_colours_of_esam_are_masks_and_grey_is_none(tmp_path: Path) -> None:
    content = read(copied(tmp_path, points="points.npy", colours="points_color.npy"))
    assert isinstance(content, Instances)
    masks = expected()["esam_masks"]
    first = np.where(masks.any(0), masks.argmax(0), -1)  # the original draws the first of masks that share a point
    np.testing.assert_array_equal(content.points, np.load(FILES / "points.npy").reshape(-1, 3))
    found = {tuple(members.tolist()) for members in content.sets()}
    assert found == {tuple(np.flatnonzero(first == k).tolist()) for k in range(len(masks)) if (first == k).any()}


# ---- variants and errors


def test_evaluation_caches_are_read_by_scene_folder(tmp_path: Path) -> None:
    value = {"feats_xyz": POINTS, "feats_feats": np.ones((6, 4), np.float32)}
    for scene in ("office0", "room0"):
        made.write_torch(tmp_path / "SemSegReplica" / scene / "map.pt", made.tensors(value))
        made.write_torch(
            tmp_path / "SemSegReplica" / scene / "text_embeds.pt", made.tensors({"text_embeds": np.ones((2, 4))})
        )
    for path in (tmp_path, tmp_path / "SemSegReplica"):
        assert list(recognise(path).scenes(path)) == ["office0", "room0"]
        assert len(read(path).points) == 6


def test_ovo_map_as_an_archive_or_with_gaussians_is_read(tmp_path: Path) -> None:
    made.write_ovo(tmp_path / "room0", POINTS, [2, 2, 7, -1, 7, 7], {7: ROW, 2: 2 * ROW}, is_stream=False)
    content = read(tmp_path)
    np.testing.assert_array_equal(content.instance, [0, 0, 1, -1, 1, 1])  # ascending: the smallest wins a tie of votes
    cloud = {"xyz": POINTS, "obj_ids": np.full((6, 1), -1, np.int32)}
    value = {"gaussian_params": cloud, "ovo_map_params": {"ins_3d_ids": np.zeros(0, np.int64)}}
    made.write_torch(tmp_path / "room0/ovo_map.ckpt", made.tensors(value), is_stream=True)
    content = read(tmp_path)
    assert (content.instance == -1).all() and len(content.features) == 0


def test_ovo_objects_without_points_or_features_give_a_remark(tmp_path: Path) -> None:
    made.write_ovo(tmp_path / "room0", POINTS, [0] * 6, {0: ROW, 3: None})
    prediction = recognise(tmp_path).read(tmp_path, "room0")
    assert prediction.remarks == (
        "1 objects have no feature (a row of zeros or NaN)",
        "1 of 2 objects have no points",
    )


@pytest.mark.parametrize(
    ("ids", "features", "message"),
    [
        ([9] * 6, {0: ROW}, "point 0 is of object 9, which the map does not have"),
        ([0] * 5, {0: ROW}, "'obj_ids' is an array of shape (5, 1) int32; expected an object for each of 6 points"),
        ([0] * 6, {0: ROW, 1: np.ones(3, np.float32)}, "the feature of object 1 is an array of shape (3,) float32"),
        ([0] * 6, {0: np.ones((2, 2), np.float32)}, "the feature of object 0 is an array of shape (2, 2) float32"),
    ],
)
def test_each_invalid_ovo_map_is_one_line(
    tmp_path: Path, ids: list[int], features: dict[int, Any], message: str
) -> None:
    made.write_ovo(tmp_path / "room0", POINTS, ids, features)
    assert message in made.refused(tmp_path, "room0", "ovo")


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ({"feats_xyz": POINTS}, "holds feats_xyz; expected a map of RayFronts, such as map.pt"),
        ({"feats_xyz": None, "feats_feats": None}, "the points are a NoneType"),
        ({"feats_xyz": POINTS, "feats_feats": np.ones((5, 4), np.float32)}, "6 positions, but the features are"),
        ({"global_vox_xyz": POINTS, "global_vox_rgb_feat_conf": np.ones((6, 4), np.float32)}, "(6, 0) float32; expect"),
        ({"global_xyz_pc": [], "global_feat_pc": []}, "holds no cloud"),
        ({"global_xyz_pc": [POINTS], "global_feat_pc": [POINTS[:, :2], POINTS]}, "expected tables of one width"),
    ],
)
def test_each_invalid_rayfronts_map_is_one_line(tmp_path: Path, value: dict[str, Any], message: str) -> None:
    made.write_torch(tmp_path / "room0.pt", made.tensors(value))
    assert message in made.refused(tmp_path, "room0", "rayfronts")


def test_objects_and_clouds_sharing_one_array_are_refused(tmp_path: Path) -> None:
    """A reference takes a few bytes in the file, but its target takes memory each time."""
    n, wide = 5_000, made.Tensor(np.ones(100_000, np.float16))
    cloud = made.tensors({"xyz": POINTS, "obj_ids": np.zeros((6, 1), np.int32)})
    objects = {"ins_3d_ids": np.arange(n)} | {f"ins3d_{k}_clip_feature": wide for k in range(n)}
    made.write_torch(tmp_path / "room0/ovo_map.ckpt", {"map_params": cloud, "ovo_map_params": objects}, is_stream=True)
    assert "unpacks to more than" in made.refused(tmp_path, "room0", "ovo")
    clouds = [made.Tensor(np.ones((100_000, 3), np.float32))] * n
    made.write_torch(tmp_path / "room0.pt", {"global_xyz_pc": clouds, "global_feat_pc": clouds})
    assert "unpacks to more than" in made.refused(tmp_path / "room0.pt", "room0", "rayfronts")


def test_each_invalid_esam_or_onlineanyseg_result_is_one_line(tmp_path: Path) -> None:
    made.write_esam(tmp_path / "room0", POINTS, [0, 1, 0, 1, -1, 0])
    colours = np.load(tmp_path / "room0/points_color.npy")
    for wrong, message in (
        (colours[:5], "expected a colour for each of points.npy, (6, 3)"),
        (colours + 200, "expected 0 to 255"),
        (colours / 255, "float64; expected a colour"),
    ):
        np.save(tmp_path / "room0/points_color.npy", wrong)
        assert message in made.refused(tmp_path, "room0", "esam")
    n = 300
    np.save(tmp_path / "room0/points.npy", np.zeros((n, 3)))
    np.save(
        tmp_path / "room0/points_color.npy",
        np.stack([np.arange(n) % 256, np.arange(n) // 256, np.zeros(n)], 1).astype(int),
    )
    assert "has 300 colours, ESAM's palette 256" in made.refused(tmp_path, "room0", "esam")
    folder = tmp_path / "online"
    made.write_onlineanyseg(folder / "room0", POINTS, [np.arange(5) < 2])
    assert "the masks are of 5 points, final.ply has 6" in made.refused(folder, "room0", "onlineanyseg")
    made.write_onlineanyseg(folder / "room0", POINTS, [np.arange(6) < 2], [ROW, ROW])
    assert "1 masks, but the features are" in made.refused(folder, "room0", "onlineanyseg")
    made.write_onlineanyseg(folder / "room0", POINTS, [np.arange(6) < 2])
    assert "class-agnostic" in recognise(folder).read(folder, "room0").remarks[0]
    assert READERS["maskclustering"].recognise(folder / "room0") is None


# ---- the older form of torch.save
