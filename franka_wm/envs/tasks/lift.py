# pyright: reportAttributeAccessIssue=false, reportIndexIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportCallIssue=false
# (Kernels are Warp's language: pyright knows neither its arrays nor its vectors.)
"""Lift: raise a cube."""

# Warp reads annotations as types: no `from __future__ import annotations` here.
import math
from typing import TYPE_CHECKING

import torch
import warp as wp

from franka_wm.envs.scene import Body, Scene
from franka_wm.envs.tasks.experts import Aim, Sight, fetch, grasp_of, moved
from franka_wm.envs.tasks.manipulation import GripperTask, effort, holds, nearness, place_of, tool_of

if TYPE_CHECKING:
    from franka_wm.envs.simulation import Simulation

HEIGHT = 0.20
"""How far up [m]."""
ABOVE = 0.03
"""How far over the goal the cube is best held [m]: at the goal itself the least tremor would be failure."""


@wp.kernel(enable_backward=False)
def lift_reward_and_success(
    state: wp.array2d[float],
    joint_target: wp.array2d[float],
    objects: wp.array2d[float],
    goal: wp.array2d[float],
    action: wp.array2d[float],
    sparse: bool,
    penalty: float,
    height: float,
    above: float,
    reward: wp.array2d[float],
    success: wp.array2d[wp.bool],
):
    world = wp.tid()
    cube = place_of(objects, world, 0)
    missing = wp.abs(goal[world, 2] + above - cube[2])
    risen = wp.max(1.0 - missing / (height + above), 0.0)
    solved = cube[2] >= goal[world, 2]
    value = 0.2 * nearness(wp.length(tool_of(state, world) - cube))
    if holds(state, joint_target, cube, world):
        value += 0.2 + 0.4 * risen
        if solved:
            value += 0.2
    if sparse:
        value = wp.where(solved, 1.0, 0.0)
    reward[world, 0] = value - penalty * effort(action, world)
    success[world, 0] = solved


class Lift(GripperTask):
    """Raise a cube by 20 cm.

    **Scene**: a table and a cube of 4 cm and 50 g. **Randomization**: the cube stands within 10 cm in x and 15 cm in y
    of (0.5, 0) m, turned by up to 45°. **Goal**: 20 cm above where the cube stood. **Success**: the cube's centre is
    that high (LiftCube of ManiSkill2: Gu et al. 2023). **Reward**, dense, in [0, 1]: 0.2 for the tool's nearness to the
    cube, 1 − tanh(5 · distance), 0.2 for holding it, and while it is held 0.4 for how much of the way to 3 cm over the
    goal it has risen, less again above that, and 0.2 where it succeeds; sparse: 1 where it succeeds. Both minus
    ``action_penalty`` · mean(action²).
    """

    scene = Scene(objects=(Body(name="cube", at=(0.5, 0.0), spread=(0.10, 0.15), turn=math.pi / 4),))
    words = "Lift the cube."

    def reset(self, sim: "Simulation", mask: wp.array) -> None:
        self.launch_goal(sim, mask, away=(0.0, 0.0, HEIGHT))

    def pose_at_goal(self, sim: "Simulation", mask: wp.array) -> None:
        """The cube up there, in the hand."""
        self.launch_goal_pose(sim, mask)

    def reward_and_success(self, sim: "Simulation") -> None:
        self.launch_reward(sim, lift_reward_and_success, HEIGHT, ABOVE)

    def measures(self, sim: "Simulation") -> dict[str, torch.Tensor]:
        return {"cube's height [m]": sim.tensors.next_true_objects[:, 2]}

    def expert(self, sight: Sight) -> Aim:
        """Grasp the cube from above and bring it a little higher than the goal."""
        return fetch(sight, 0, moved(sight.goal, z=ABOVE), **grasp_of(self.objects[0]))[0]
