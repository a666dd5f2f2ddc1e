"""What happens on the live page, as a video."""

from __future__ import annotations

from pathlib import Path

import torch

from franka_wm.envs import FrankaEnv
from franka_wm.envs.camera import project
from franka_wm.errors import UserError
from franka_wm.report.video import draw_marker, write_video


class VideoRecorder:
    """Collects one picture a step, from the environment's own camera, the goal drawn as a ring.

    Args:
        env: Whose first world is filmed.
        size: Side of the picture [px], even.
        most: Pictures after which it is full: they are kept in memory (480² px: 0.7 MB each).
    """

    def __init__(self, env: FrankaEnv, *, size: int = 480, most: int = 1800):
        self.env, self.size, self.most = env, size, most
        self.frames: list[torch.Tensor] = []

    @property
    def full(self) -> bool:
        """Whether no further picture is taken."""
        return len(self.frames) >= self.most

    def take(self) -> None:
        """One picture of the present; nothing where it is full."""
        if self.full:
            return
        picture = self.env.render(self.size, num_views=1).cpu()
        centre = project(self.env.goal[:1], self.env.config, self.size).cpu()
        self.frames.append(draw_marker(picture, centre, radius=self.size / 32)[0])

    def write(self, path: str | Path) -> Path:
        """Writes the .mp4 at the environment's own rate, however fast it was simulated.

        Raises:
            UserError: No picture was taken, or the file cannot be written.
        """
        if not self.frames:
            raise UserError(
                f"nothing was recorded for {path}: play for a moment before stopping the recording"
            )
        return write_video(torch.stack(self.frames), path, fps=max(1, round(self.env.config.fps)))
