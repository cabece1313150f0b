"""A small scene in the files of ARKitScenes' raw release and of the OpenSUN3D challenge: a floor, seen from above."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from recording_files import HEIGHT_M, floor_image, grid, pose, write_files, write_mesh

SCENE, QUERY = "42445173", "the mat, and nothing else"
WHERE = f"arkitscenes/{SCENE}"
SIZE, POSES = (64, 48), [pose(x_m) for x_m in (1.5, 2.0, 2.5)]
TIMES = ("100.000", "100.100", "100.200")
TRUTH = f"challenge_track_1/benchmark_data/gt_development_scenes/{SCENE}.txt"
QUERIES = "challenge_track_1/benchmark_file_lists/queries_development_scenes.csv"


def write_images(folder: Path, colour: str, depth: str, size: tuple[int, int]) -> None:
    """Colour, depth, camera files and confidence; the camera sees 2 m of the floor."""
    values, confidence = np.full(size[::-1], round(HEIGHT_M * 1000), np.uint16), np.full(size[::-1], 2, np.uint8)
    values[0, 0], confidence[:, :4] = 0, 1
    for time, matrix in zip(TIMES, POSES, strict=True):
        files: dict[str, Any] = {
            f"{colour}/{SCENE}_{time}.png": floor_image(size, float(matrix[0, 3])),
            f"{depth}/{SCENE}_{time}.png": values,
            f"confidence/{SCENE}_{time}.png": confidence,
            f"{colour}_intrinsics/{SCENE}_{time}.pincam": f"{size[0]} {size[1]} {size[0]} {size[0]} "
            f"{size[0] / 2} {size[1] / 2}\n",
        }
        write_files(folder, files)


def write_scene(root: Path, *, is_3dod: bool = False) -> Path:
    """The scene in the layout of the challenge, or of the 3DOD release; its image folder."""
    scene = root / ("3dod/Training" if is_3dod else "ChallengeDevelopmentSet") / SCENE
    folder = scene / f"{SCENE}_frames" if is_3dod else scene
    write_images(folder, "lowres_wide", "lowres_depth", SIZE)
    shifts = [np.linalg.inv(matrix)[:3, 3] for matrix in POSES]  # with a half turn about x
    lines = [f"{time}4 {np.pi!r} 0 0 {x} {y} {z}\n" for time, (x, y, z) in zip(TIMES, shifts, strict=True)]
    vertices, faces = grid(4, 2)
    write_mesh(scene / f"{SCENE}_3dod_mesh.ply", vertices, faces)
    write_files(folder, {"lowres_wide.traj": "".join(lines)})
    numbers = [0] * (len(vertices) - 4) + [1, 1, 1002, 2000]
    challenge = {
        TRUTH: "".join(f"{number}\n" for number in numbers),
        QUERIES: f'\ufeffvideo_id,visit_id,query\r\n{SCENE},420693,"{QUERY}"\r\n\r\n',
        QUERIES.replace("queries_", "challenge_"): f"video_id,visit_id,fold\n{SCENE},420693,Training",
    }
    write_files(root, challenge)
    return folder
