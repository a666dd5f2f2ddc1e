"""Draws the pictures of README and docs with the embedded renderer.

python docs/make_pictures.py
"""

from pathlib import Path

import torch

from franka_wm import conf
from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.policies.expert import ExpertPolicy
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

    experts = [
        expert_at_work(task, step)
        for task in ("lift", "push", "pick", "stack", "drawer", "peg")
        for step in ((0, 34, 80) if task == "peg" else (0, 22, 50))
    ]
    write_png(tile_frames(torch.stack(experts).unsqueeze(0), columns=6)[0], FOLDER / "experts.png")


def expert_at_work(task: str, step: int) -> torch.Tensor:
    """What the camera of the preset sees after so many steps of the task's expert, (H, W, 3) uint8."""
    cfg = conf.compose(f"env={task}", "env.enable_shadows=true")
    values = {str(name): value for name, value in cfg.env.items() if name not in ("kind", "urdf_path")}
    env = FrankaEnv(FrankaConfig.from_mapping(values), num_envs=1, device="cpu", seed=1)
    expert = ExpertPolicy(env.simulation.task, env.kinematics, env.config)
    root = env.reset()
    for _ in range(step):
        root = env.step_and_maybe_reset(expert(root))[1]
    return torch.as_tensor(env.render(240, samples=3)[0]).clone()


if __name__ == "__main__":
    main()
