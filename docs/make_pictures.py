"""Draws the pictures of README and docs with the embedded renderer.

python docs/make_pictures.py
"""

from pathlib import Path

import torch

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.video import tile_frames, write_png

FOLDER = Path(__file__).parent / "images"


def main() -> None:
    config = FrankaConfig(
        observations=("state",), enable_shadows=True, gravity_compensation=True, pose_noise=0.5
    )
    arms = FrankaEnv(config, num_envs=6, device="cpu", seed=11)
    arms.reset()
    write_png(tile_frames(arms.render(320, samples=3).unsqueeze(0), columns=3)[0], FOLDER / "arms.png")

    # What a model sees: 64 × 64, enlarged without smoothing.
    seen = FrankaEnv(FrankaConfig(pose_noise=0.5), num_envs=12, device="cpu", seed=5)
    pixels = seen.reset()["pixels"]
    large = pixels.repeat_interleave(2, 1).repeat_interleave(2, 2)
    write_png(tile_frames(torch.as_tensor(large).unsqueeze(0), columns=6)[0], FOLDER / "observations.png")


if __name__ == "__main__":
    main()
