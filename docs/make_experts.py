"""Films the experts of the six tasks with the embedded renderer: a clip and a picture of three moments each.

python docs/make_experts.py
"""

from pathlib import Path

import torch
import warp as wp
from PIL import Image

from franka_wm import conf
from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.camera import Camera, as_torch, look_at
from franka_wm.files import atomic_write
from franka_wm.policies.expert import ExpertPolicy
from franka_wm.video import draw_labels, tile_frames, write_png

FOLDER = Path(__file__).parent / "images"
TASKS = ("lift", "push", "pick", "stack", "drawer", "peg")
FPS, SECONDS, PAUSE = 12, 6, 8
"""Of the clip; frames that it rests after each success."""
SIZE, HEIGHT = 256, 208
"""Side of the square that is rendered, and what is left of it [px]."""
EYE, TARGET = (1.15, 0.75, 0.62), (0.40, 0.0, 0.20)
BESIDE, DRAWER = (0.75, 1.15, 0.75), (0.50, 0.0, 0.16)
"""Where the camera stands and looks to [m]; of the drawer, whose front faces the robot, from beside."""


class Stage:
    """One world, its expert, and a camera that sees the whole arm.

    Args:
        task: Its name.
        seed: Of where objects start.
    """

    def __init__(self, task: str, seed: int = 1):
        changes = ["env.enable_shadows=true", "env.episode_length=1000000"]
        if task in ("push", "pick"):  # else one cannot see what is asked
            changes += ["env.show_goal=true", "env.observations=[pixels,state,joint_target,objects]"]
        cfg = conf.compose(f"env={task}", *changes)
        values = {str(name): value for name, value in cfg.env.items() if name not in ("kind", "urdf_path")}
        config = FrankaConfig.from_mapping(values | {"camera_fov_degrees": 45.0})
        self.env = FrankaEnv(config, num_envs=1, device="cpu", seed=seed)
        self.expert = ExpertPolicy(self.env.simulation.task, self.env.kinematics, self.env.config)
        self.camera = Camera(self.env.model, config, size=SIZE, samples=3)
        aim = look_at(BESIDE, DRAWER) if task == "drawer" else look_at(EYE, TARGET)
        self.camera.transforms = wp.array([aim], dtype=wp.transformf)
        self.root = self.env.reset()

    def step(self) -> bool:
        """One step of the expert; whether the task is done."""
        done, self.root = self.env.step_and_maybe_reset(self.expert(self.root))
        return bool(done["next", "success"])

    def picture(self) -> torch.Tensor:
        """(HEIGHT, SIZE, 3) uint8."""
        sim = self.env.simulation
        self.env.model.bvh_refit_shapes(sim.newton_state)
        self.camera.render(sim.newton_state, sim.warp, sim.chain)
        top = (SIZE - HEIGHT) // 2
        return as_torch("pixels", self.camera.images["pixels"])[0, top : top + HEIGHT].clone()


def film(task: str) -> torch.Tensor:
    """Episode after episode in its own time, (FPS · SECONDS, HEIGHT, SIZE, 3) uint8."""
    stage, frames, steps, rested = Stage(task), [], 0, 0
    for frame in range(FPS * SECONDS):
        frames.append(stage.picture())
        done = False
        while steps < (frame + 1) * stage.env.config.fps / FPS:
            done, steps = stage.step(), steps + 1
        rested = rested + 1 if done else 0
        if rested > PAUSE:
            stage.root, rested = stage.env.reset(), 0
    return torch.stack(frames)


def moments(task: str) -> list[torch.Tensor]:
    """The start, half of the way, and the moment of success, (HEIGHT, SIZE, 3) uint8 each."""
    stage, length = Stage(task), 1
    while not stage.step():
        length += 1
    stage, shown = Stage(task), []
    for step in range(length + 1):
        if step in (0, length // 2, length):
            shown.append(stage.picture())
        stage.step()
    return shown


def main() -> None:
    pictures = torch.stack([torch.stack(moments(task)) for task in TASKS], 1)  # (3, 6, …)
    labelled = draw_labels(pictures, TASKS).flatten(0, 1)
    write_png(tile_frames(labelled.unsqueeze(0), columns=len(TASKS))[0], FOLDER / "experts.png")
    films = torch.stack([film(task) for task in TASKS], 1)  # (frames, 6, …)
    first, *rest = [
        Image.fromarray(frame.numpy()) for frame in tile_frames(draw_labels(films, TASKS), columns=3)
    ]
    with atomic_write(FOLDER / "experts.webp") as temporary:
        first.save(
            temporary, format="WEBP",
            save_all=True, append_images=rest, duration=round(1000 / FPS), loop=0, quality=70, method=6,
        )  # fmt: skip


if __name__ == "__main__":
    main()
