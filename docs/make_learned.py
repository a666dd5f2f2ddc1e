"""Films the small trained agent of `franka-wm demo`: six arms, three goals each, with the embedded renderer.

python docs/make_learned.py
"""

from pathlib import Path

import torch
from PIL import Image
from torchrl.envs.utils import ExplorationType, set_exploration_type

from franka_wm.commands.demo import AGENT
from franka_wm.envs import FrankaEnv
from franka_wm.files import atomic_write
from franka_wm.training.load import load_agent
from franka_wm.video import tile_frames

CLIP = Path(__file__).parent / "images" / "learned.webp"
ARMS, EPISODES, SEED = 6, 3, 0
FPS, EVERY = 15, 2
"""Of the clip; steps of the arm, 30 a second, between two frames."""
SIZE = 256
"""Of each arm's square [px]."""


@torch.no_grad()
def film() -> torch.Tensor:
    """Episode after episode in their own time, (frames, arms, SIZE, SIZE, 3) uint8."""
    agent = load_agent(
        AGENT, num_envs=ARMS, device="cpu", env_changes={"show_goal": True, "enable_shadows": True}, seed=SEED
    )
    env, policy, frames = agent.env, agent.policies["planner"], []
    assert isinstance(env, FrankaEnv)
    root = env.reset()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for step in range(EPISODES * env.config.episode_length):
            if step % EVERY == 0:
                frames.append(env.render(SIZE, samples=3))
            _, root = env.step_and_maybe_reset(policy(root))
    return torch.stack(frames)


def main() -> None:
    first, *rest = [Image.fromarray(frame.numpy()) for frame in tile_frames(film(), columns=3)]
    with atomic_write(CLIP) as temporary:
        first.save(
            temporary, format="WEBP",
            save_all=True, append_images=rest, duration=round(1000 / FPS), loop=0, quality=70, method=6,
        )  # fmt: skip
    print(CLIP)


if __name__ == "__main__":
    main()
