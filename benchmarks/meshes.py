"""What thinning out a robot's meshes costs in images: triangles, and the difference from drawing them all.

python benchmarks/meshes.py                  64 x 64, 16 worlds in diverged poses; needs the extra [meshes]
"""

from __future__ import annotations

import argparse
from typing import Any

import torch
from common import publish

from franka_wm.envs import FrankaConfig, FrankaEnv

DETAILS = [0.004, 0.008, 0.012, 0.016, 0.02, 0.03]


def seen(detail: float, size: int) -> tuple[int, torch.Tensor]:
    """Triangles of one robot, and its images (worlds, size, size, 3)."""
    config = FrankaConfig(robot="panda_meshes", mesh_detail=detail, image_size=size, observations=("pixels",))
    env = FrankaEnv(config, num_envs=16, device="cpu")
    meshes = {id(mesh): mesh for mesh in env.model.shape_source if hasattr(mesh, "indices")}
    return sum(len(mesh.indices) // 3 for mesh in meshes.values()), env.reset(seed=0)["pixels"].float()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", type=int, default=64, help="pixels a side")
    parser.add_argument("--out", help="JSON file")
    arguments = parser.parse_args()
    all_triangles, whole = seen(0.0, arguments.size)
    rows: list[dict[str, Any]] = [{"mesh_detail [m]": 0, "triangles": all_triangles, "difference": 0.0}]
    for detail in DETAILS:
        triangles, pictures = seen(detail, arguments.size)
        difference = float((pictures - whole).abs().mean())
        rows.append({"mesh_detail [m]": detail, "triangles": triangles, "difference": difference})
        print(rows[-1], flush=True)
    publish("meshes", rows, arguments.out, device="cpu")


if __name__ == "__main__":
    main()
