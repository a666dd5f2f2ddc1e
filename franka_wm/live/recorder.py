"""What happens on the live page, as a video or as a LeRobot dataset."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase

from franka_wm.console import say
from franka_wm.envs import FrankaEnv
from franka_wm.envs.camera import project, whole_arm
from franka_wm.envs.transformed import arm_of
from franka_wm.errors import UserError
from franka_wm.keys import LOST
from franka_wm.video import draw_marker, write_video

MEMORY = 10**9
"""What the steps of a dataset may take in memory [bytes]; writing it takes as much again."""


class Recorder:
    """What recorders share: they end at ``most`` steps, or when closed."""

    most: int
    closed = False

    def __len__(self) -> int:
        """Steps recorded."""
        raise NotImplementedError

    @property
    def full(self) -> bool:
        """Whether no further step has a place."""
        return len(self) >= self.most

    def take(self, step: TensorDictBase) -> None:
        """One step: observation, ``action`` and, under ``next``, what followed; nothing where it is full or closed."""
        if self.closed or self.full:
            return
        self._take(step)
        if self.full:
            say(
                f"the recording is full after {len(self):,} steps: further ones are not in it; stop it to save it"
            )

    def _take(self, step: TensorDictBase) -> None:
        raise NotImplementedError

    def close(self) -> None:
        """Takes no more steps; what there is can be written, and written again where that failed."""
        self.closed = True


class VideoRecorder(Recorder):
    """Collects one image a step, from a camera that has the whole arm in view, the goal drawn as a ring.

    Args:
        env: Whose first world is filmed.
        size: Side of the image [px], even.
        most: Images after which it is full: they are kept in memory (480² px: 0.7 MB each).
    """

    def __init__(self, env: FrankaEnv, *, size: int = 480, most: int = 1800):
        self.env, self.size, self.most = env, size, most
        self.whole = whole_arm(env.config, env.kinematics)
        self.frames: list[torch.Tensor] = []

    def __len__(self) -> int:
        """Steps recorded."""
        return len(self.frames)

    def _take(self, step: TensorDictBase) -> None:
        """One image of the present; ``step`` is not looked at."""
        image = self.env.render(self.size, num_views=1, config=self.whole).cpu()
        centre = project(self.env.goal[:1], self.whole, self.size).cpu()
        self.frames.append(draw_marker(image, centre, radius=self.size / 32)[0])

    def write(self, path: str | Path) -> Path:
        """Writes the .mp4 at the environment's own rate, however fast it was simulated.

        Raises:
            UserError: No image was taken, or the file cannot be written.
        """
        if not self.frames:
            raise UserError(
                f"nothing was recorded for {path}: play for a moment before stopping the recording"
            )
        return write_video(torch.stack(self.frames), path, fps=max(1, round(self.env.config.fps)))


class DatasetRecorder(Recorder):
    """Collects steps for a LeRobot dataset; what :func:`~franka_wm.data.lerobot.schema.schema_for` lists is kept.

    An episode of the dataset begins with the recording or with an episode of the environment, and ends with either;
    one that the recording cut off counts as truncated. Where a goal was dragged, the next row simply has another one.

    Args:
        env: The world, with its transforms.
        seed: Seed of the session.
        policy: Who acts at the start, for the dataset's provenance.
        format: How images are stored; see :data:`~franka_wm.data.lerobot.schema.FORMATS`.
        most: Steps after which it is full; fewer where so many take more than :data:`MEMORY`.

    Raises:
        UserError: The environment observes something that has no place in a dataset.
    """

    def __init__(
        self, env: Any, *, seed: int = 0, policy: str = "", format: str = "exact", most: int = 20_000
    ):
        from franka_wm.data.lerobot.schema import schema_for

        self.env, self.seed, self.policy, self.most = env, seed, policy, most
        arm = arm_of(env)
        assert arm is not None
        self.arm = arm
        self.schema = schema_for(self.arm.config, format=format)
        self.steps: list[TensorDictBase] = []

    def __len__(self) -> int:
        """Steps recorded."""
        return len(self.steps)

    def _take(self, step: TensorDictBase) -> None:
        keys = {*self.schema.sources.values(), *(key for key, _, _ in self.schema.derived.values())}
        flags = ("reward", "done", "terminated", "truncated", "success", LOST)
        after = step.get("next").select(*keys, *(flag for flag in flags if flag in step["next"]))
        self.steps.append(step.select(*keys, "action", "is_init").set("next", after).cpu().clone())
        if len(self.steps) == 1:  # all others are as large
            self.most = min(self.most, max(1, MEMORY // self.steps[0].bytes()))

    def write(self, path: str | Path) -> Path:
        """Writes the dataset's folder, which appears whole.

        Raises:
            UserError: No step was taken, or the folder cannot be written.
        """
        from franka_wm.data.lerobot.episodes import EpisodeCutter, tell_lost
        from franka_wm.data.lerobot.provenance import describe
        from franka_wm.data.lerobot.writer import DatasetWriter

        if not self.steps:
            raise UserError(
                f"nothing was recorded for {path}: play for a moment before stopping the recording"
            )
        batch: Any = torch.stack(self.steps, 1)  # type: ignore[arg-type, call-overload]
        first, ended = batch["is_init"], batch["next", "done"]
        first[:, 0] = True
        cut = torch.ones_like(ended)  # before a beginning there is an end, also where a button was the reason
        cut[:, :-1] = first[:, 1:]
        batch["next", "truncated"] |= cut & ~ended
        ended |= cut
        table = None if self.env.action_spec.dtype.is_floating_point else self.env.transform.table
        # It was played by hand and cannot be repeated, so episodes have no numbers.
        cutter = EpisodeCutter(self.schema, seed=self.seed, numbered=False, discrete=table)
        provenance = describe(
            policy=f"live session, began with {self.policy}",
            seed=self.seed,
            config={"env": {"urdf_path": self.arm.urdf_path, **_plain(asdict(self.arm.config))}},
        )
        with DatasetWriter(path, self.schema, provenance=provenance, workers=0) as writer:
            writer.add(cutter.push(batch))
            tell_lost("recording", cutter.lost)
            return writer.finish()


def _plain(value: Any) -> Any:
    """For JSON: tuples as lists, numpy's numbers as Python's."""
    if isinstance(value, dict):
        return {key: _plain(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return value.item() if isinstance(value, np.generic) else value
