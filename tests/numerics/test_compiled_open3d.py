from __future__ import annotations

import subprocess
import sys

CAST = """
rays = o3d.core.Tensor(np.array([[0.1, 0.1, 0, 0, 0, 1]], np.float32))
scene = o3d.t.geometry.RaycastingScene()
corners, triangle = np.array([[0, 0, 2], [1, 0, 2], [0, 1, 2]], np.float32), np.array([[0, 1, 2]], np.uint32)
scene.add_triangles(o3d.core.Tensor(corners), o3d.core.Tensor(triangle))
assert abs(scene.cast_rays(rays)["t_hit"].numpy()[0] - 2) < 1e-5
"""


def test_compiled_module_casts_rays_and_the_package_can_be_imported_later() -> None:
    text = (
        "import sys; import numpy as np; from su3d_bench.numerics.open3d_core import compiled_open3d\n"
        f"o3d = compiled_open3d(){CAST}"
        "assert sys.platform != 'linux' or compiled_open3d() is o3d\n"
        f"import open3d as o3d{CAST}assert compiled_open3d() is o3d"
    )
    subprocess.run([sys.executable, "-c", text], check=True, timeout=300)
