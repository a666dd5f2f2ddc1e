"""Draws the pictures of README and docs with the embedded renderer.

python docs/make_pictures.py
"""

from pathlib import Path

import torch

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.video import tile_frames, write_png

FOLDER = Path(__file__).parent / "images"


def main() -> None:
    # What a model sees: 64 × 64, enlarged without smoothing.
    seen = FrankaEnv(FrankaConfig(pose_noise=0.5), num_envs=12, device="cpu", seed=5)
    pixels = seen.reset()["pixels"]
    large = pixels.repeat_interleave(2, 1).repeat_interleave(2, 2)
    write_png(tile_frames(torch.as_tensor(large).unsqueeze(0), columns=6)[0], FOLDER / "observations.png")


if __name__ == "__main__":
    main()
