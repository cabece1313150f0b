"""A small scene in the files of ARKitScenes' raw release and of the OpenSUN3D challenge: a floor, seen from above."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scannet_scan import floor_image, grid, write_mesh

from su3d_bench.core.types import Float64Array
from su3d_bench.datasets.arkitscenes.frames import trajectory_line
from su3d_bench.formats.images import png_bytes

SCENE, QUERY = "42445173", "the mat, and nothing else"
WHERE = f"arkitscenes/{SCENE}"
SIZE, HEIGHT_M, N_FRAMES = (64, 48), 2.0, 3
TRUTH = f"challenge_track_1/benchmark_data/gt_development_scenes/{SCENE}.txt"
QUERIES = "challenge_track_1/benchmark_file_lists/queries_development_scenes.csv"


def pose(x_m: float) -> Float64Array:
    """Above the floor at ``x_m``, 1 m from its edge, looking down."""
    matrix = np.diag([1.0, -1.0, -1.0, 1.0])
    matrix[:3, 3] = x_m, 1.0, HEIGHT_M
    return matrix


def poses() -> list[Float64Array]:
    return [pose(float(x_m)) for x_m in np.linspace(1.5, 2.5, N_FRAMES)]


def time_of(k: int) -> str:
    return f"{100 + k / 10:.3f}"


def write_images(folder: Path, colour: str, depth: str, size: tuple[int, int], depth_size: tuple[int, int]) -> None:
    """Colour, depth, camera files and, for images of low resolution, confidence; the camera sees 2 m of the floor."""
    folders = (colour, depth, f"{colour}_intrinsics", "confidence")
    for name in folders:
        (folder / name).mkdir(parents=True, exist_ok=True)
    for k, matrix in enumerate(poses()):
        stem = f"{SCENE}_{time_of(k)}"
        values = np.full(depth_size[::-1], round(HEIGHT_M * 1000), np.uint16)
        values[0, 0] = 0
        confidence = np.full(depth_size[::-1], 2, np.uint8)
        confidence[:, :4] = 1
        (folder / colour / f"{stem}.png").write_bytes(png_bytes(floor_image(size, float(matrix[0, 3]))))
        (folder / depth / f"{stem}.png").write_bytes(png_bytes(values))
        (folder / "confidence" / f"{stem}.png").write_bytes(png_bytes(confidence))
        camera = f"{size[0]} {size[1]} {size[0]} {size[0]} {size[0] / 2} {size[1] / 2}\n"
        (folder / f"{colour}_intrinsics" / f"{stem}.pincam").write_text(camera)


def write_challenge(root: Path, numbers: list[int]) -> None:
    """A clone of the challenge's repository, as far as it is read."""
    for name, text in {
        TRUTH: "".join(f"{number}\n" for number in numbers),
        QUERIES: f'\ufeffvideo_id,visit_id,query\r\n{SCENE},420693,"{QUERY}"\r\n\r\n',
        QUERIES.replace("queries_", "challenge_"): f"video_id,visit_id,fold\n{SCENE},420693,Training",
    }.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)


def write_scene(root: Path, *, is_3dod: bool = False) -> Path:
    """The scene in the layout of the challenge, or of the 3DOD release; the folder of its images."""
    scene = root / ("3dod/Training" if is_3dod else "ChallengeDevelopmentSet") / SCENE
    folder = scene / f"{SCENE}_frames" if is_3dod else scene
    write_images(folder, "lowres_wide", "lowres_depth", SIZE, SIZE)
    lines = [trajectory_line(f"{100.0004 + k / 10:.6f}", matrix) for k, matrix in enumerate(poses())]
    (folder / "lowres_wide.traj").write_text("".join(lines))
    vertices, faces = grid(4, 2)
    write_mesh(scene / f"{SCENE}_3dod_mesh.ply", vertices, faces)
    write_challenge(root, [0] * (len(vertices) - 4) + [1, 1, 1002, 2000])
    return folder
