"""Track: keep the tool on a goal that moves."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from franka_wm.envs import kernels
from franka_wm.envs.config import FrankaConfig
from franka_wm.envs.tasks.reach import Reach

if TYPE_CHECKING:
    from franka_wm.envs.simulation import Simulation


class Track(Reach):
    """Follow a goal that moves on an upright circle.

    **Goal**: a circle of ``track_radius`` in the plane x = const around a centre that is chosen as
    :class:`Reach` chooses its goal; one turn in ``track_period`` seconds, from a random phase. What is observed
    is the goal's position at that moment. **Reward** and **success**: as in :class:`Reach`, at that moment.
    """

    def __init__(self, config: FrankaConfig):
        super().__init__(config)
        self._center: wp.array | None = None

    def reset(self, sim: Simulation, mask: wp.array) -> None:
        self.choose(sim, mask, sim.warp.goal_center)
        self._move(sim, mask, everywhere=False, ahead=0)

    def advance(self, sim: Simulation) -> None:
        self._move(
            sim, sim.warp.arms_mask, everywhere=True, ahead=1
        )  # the step is counted after the observation

    def _move(self, sim: Simulation, mask: wp.array, *, everywhere: bool, ahead: int) -> None:
        w, c = sim.warp, self.config
        wp.launch(
            kernels.circle_goal,
            sim.num_envs,
            [
                mask, everywhere, w.seed, w.episode, w.step_count, w.phase, ahead, 1.0 / c.fps, c.track_radius,
                c.track_period, w.goal_center, w.task_goal,
            ],
            device=sim.device,
        )  # fmt: skip
