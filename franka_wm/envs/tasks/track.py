# pyright: reportIndexIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportCallIssue=false
# (Kernels are Warp's language: pyright knows neither its arrays nor its vectors.)
"""Track: keep the tool on a goal that moves."""

# Warp reads annotations as types: no `from __future__ import annotations` here.
import math
from typing import TYPE_CHECKING

import torch
import warp as wp

from franka_wm.envs.kernels import episode_rng
from franka_wm.envs.tasks.reach import Reach

if TYPE_CHECKING:
    from franka_wm.envs.simulation import Simulation


@wp.kernel(enable_backward=False)
def circle_goal(
    mask: wp.array[wp.bool],
    everywhere: bool,
    seed: wp.array[int],
    episode: wp.array[int],
    step_count: wp.array2d[int],
    phase: wp.array[float],
    ahead: int,
    dt: float,
    radius: float,
    period: float,
    lowest: float,
    raised: wp.array[float],
    center: wp.array2d[float],
    goal: wp.array2d[float],
):
    """The goal on an upright circle that faces the robot, at the time of ``step_count`` + ``ahead``."""
    world = wp.tid()
    if everywhere or mask[world]:
        if not everywhere:  # a new episode; kept, so that a state can be continued in another world
            rng = episode_rng(seed[0], seed[1] + world, episode[world], 6)
            phase[world] = wp.randf(rng, 0.0, 2.0 * wp.pi)
        angle = phase[world] + 2.0 * wp.pi * float(step_count[world, 0] + ahead) * dt / period
        goal[world, 0] = center[world, 0]
        goal[world, 1] = center[world, 1] + radius * wp.cos(angle)
        goal[world, 2] = wp.max(center[world, 2] + radius * wp.sin(angle), lowest + raised[world])


class Track(Reach):
    """Follow a goal that moves on an upright circle.

    **Goal**: a circle of ``track_radius`` in the plane x = const around a centre that is chosen as
    :class:`Reach` chooses its goal, but 5 cm above ground and table where it would be lower; one turn in
    ``track_period`` seconds, from a random phase. What is observed is the goal's position at that moment.
    **Reward** and **success**: as in :class:`Reach`, at that moment.
    """

    lowest_goal = 0.05
    own_options = (*Reach.own_options, "track_radius", "track_period")
    words = "Follow the moving goal with the tool."

    @property
    def clear(self) -> float:
        """Distance of the centre: all of the circle is as far from obstacles as a goal that stands still [m]."""
        return super().clear + self.config.track_radius

    def reset(self, sim: "Simulation", mask: wp.array) -> None:
        self.choose(sim, mask, sim.warp.goal_center)
        self._move(sim, mask, everywhere=False, ahead=0)

    def advance(self, sim: "Simulation") -> None:
        self._move(sim, sim.warp.mask, everywhere=True, ahead=1)  # the step is counted after the observation

    def goal_was_set(self, sim: "Simulation") -> None:
        t, c = sim.tensors, self.config
        angle = t.phase + 2.0 * math.pi * t.step_count.squeeze(-1) / (c.fps * c.track_period)
        circle = torch.stack([torch.zeros_like(angle), angle.cos(), angle.sin()], -1)
        t.goal_center.copy_(t.task_goal - c.track_radius * circle)

    def _move(self, sim: "Simulation", mask: wp.array, *, everywhere: bool, ahead: int) -> None:
        w, c = sim.warp, self.config
        wp.launch(
            circle_goal,
            sim.num_envs,
            [
                mask, everywhere, w.seed, w.episode, w.step_count, w.phase, ahead, 1.0 / c.fps, c.track_radius,
                c.track_period, self.lowest_goal + self.table_top, w.raised, w.goal_center, w.task_goal,
            ],
            device=sim.device,
        )  # fmt: skip
