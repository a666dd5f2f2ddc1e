# pyright: reportAttributeAccessIssue=false, reportIndexIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportCallIssue=false
# (Kernels are Warp's language: pyright knows neither its arrays nor its vectors.)
"""Pick: bring a cube to a point in the air."""

# Warp reads annotations as types: no `from __future__ import annotations` here.
import math
from typing import TYPE_CHECKING

import torch
import warp as wp
from tensordict import TensorDictBase

from franka_wm.envs.kernels import away_from_solids
from franka_wm.envs.scene import Body, Scene
from franka_wm.envs.tasks.experts import Aim, Sight, fetch, grasp_of
from franka_wm.envs.tasks.manipulation import (
    GripperTask,
    effort,
    fastest_joint,
    held_in_torch,
    holds,
    near_in_torch,
    nearness,
    place_of,
    relabel_place,
    tool_of,
)
from franka_wm.envs.tasks.reach import CLEAR

if TYPE_CHECKING:
    from franka_wm.envs.simulation import Simulation

NEAR, REST = 0.025, 0.2
"""From the goal, at most [m]; the arm is at rest where no joint is faster [rad/s]."""
MIDDLE, HALF, HIGHEST = wp.constant(0.5), wp.constant(0.10), wp.constant(0.30)
"""The goal's x in the middle of its range, half of the range of x and y, and its largest height over the cube's [m]."""
ATTEMPTS = wp.constant(16)  # of so many places the first clear one is the goal


@wp.kernel(enable_backward=False)
def goal_in_the_air(
    mask: wp.array[wp.bool],
    draws: wp.array2d[float],
    rest_q: wp.array2d[float],
    raised: wp.array[float],
    solids: wp.array2d[float],
    clear: float,
    goal: wp.array2d[float],
):
    """The first of some places that is clear of obstacles; where none is, the one where the cube stands."""
    world = wp.tid()
    if mask[world]:
        place = wp.vec3f(rest_q[world, 2], rest_q[world, 3], rest_q[world, 4])  # behind two fingers
        for j in range(ATTEMPTS):
            k = 3 * (ATTEMPTS - 1 - j)  # the first one last
            x = MIDDLE + HALF * (2.0 * draws[world, k] - 1.0)
            y = HALF * (2.0 * draws[world, k + 1] - 1.0)
            at = wp.vec3f(x, y, rest_q[world, 4] + HIGHEST * draws[world, k + 2])
            if away_from_solids(at, raised[world], solids) > clear:
                place = at
        for i in range(3):
            goal[world, i] = place[i]


@wp.kernel(enable_backward=False)
def pick_reward_and_success(
    state: wp.array2d[float],
    joint_target: wp.array2d[float],
    objects: wp.array2d[float],
    goal: wp.array2d[float],
    action: wp.array2d[float],
    sparse: bool,
    penalty: float,
    near: float,
    rest: float,
    reward: wp.array2d[float],
    success: wp.array2d[wp.bool],
):
    world = wp.tid()
    cube = place_of(objects, world, 0)
    missing = wp.length(wp.vec3f(goal[world, 0], goal[world, 1], goal[world, 2]) - cube)
    speed = fastest_joint(state, world)
    solved = missing <= near and speed < rest
    value = 0.2 * nearness(wp.length(tool_of(state, world) - cube))
    if holds(state, joint_target, cube, world):
        value += 0.2 + 0.4 * nearness(missing)
        if missing <= near:
            value += 0.2 * nearness(speed)
    if solved:
        value = 1.0
    if sparse:
        value = wp.where(solved, 1.0, 0.0)
    reward[world, 0] = value - penalty * effort(action, world)
    success[world, 0] = solved


def pick_reward(
    state: torch.Tensor, joint_target: torch.Tensor, objects: torch.Tensor, goal: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """The same in torch, see :data:`~franka_wm.envs.tasks.manipulation.RewardInTorch`."""
    cube = objects[..., :3]
    missing, speed = (goal - cube).norm(dim=-1), state[..., 7:14].abs().amax(-1)
    near = missing <= NEAR
    solved = near & (speed < REST)
    held = 0.2 + 0.4 * near_in_torch(missing) + 0.2 * near_in_torch(speed) * near
    value = 0.2 * near_in_torch((state[..., 14:17] - cube).norm(dim=-1))
    value = value + held * held_in_torch(state, joint_target, cube)
    return torch.where(solved, 1.0, value), solved


class Pick(GripperTask):
    """Bring a cube to a point in the air and keep it there.

    **Scene**: a table and a cube of 4 cm and 50 g. **Randomization**: the cube stands within 10 cm in x and y of
    (0.5, 0) m, turned by up to 45°; the goal lies within 10 cm of it in x and y, up to 30 cm over the resting cube and
    5 cm from obstacles. **Success**: the cube's centre is at most 2.5 cm from the goal, and no joint of the arm faster
    than 0.2 rad/s (ManiSkill3's PickCube: Tao et al. 2024; 50 steps at 20 Hz, joints within 0.02 rad of the same pose).
    **Reward**, dense, in [0, 1]: 1 where it succeeds; else 0.2 for the tool's nearness to the cube, 1 − tanh(5 ·
    distance), 0.2 for holding it, and while it is held 0.4 for its nearness to the goal, and there 0.2 for slow joints;
    sparse: 1 where it succeeds. Both minus ``action_penalty`` · mean(action²).
    """

    scene = Scene(objects=(Body(name="cube", at=(0.5, 0.0), spread=(0.10, 0.10), turn=math.pi / 4),))
    num_draws = 3 * ATTEMPTS
    words = "Bring the cube to the goal."
    relabel_reads = ("state", "joint_target", "objects")
    achieved = ("objects", slice(0, 3))

    def reset(self, sim: "Simulation", mask: wp.array) -> None:
        w = sim.warp
        inputs = [mask, w.draws, w.rest_q, w.raised, w.solids, CLEAR, w.task_goal]
        wp.launch(goal_in_the_air, sim.num_envs, inputs, device=sim.device)

    def pose_at_goal(self, sim: "Simulation", mask: wp.array) -> None:
        """The cube at the goal, in the hand."""
        self.launch_goal_pose(sim, mask)

    def reward_and_success(self, sim: "Simulation") -> None:
        self.launch_reward(sim, pick_reward_and_success, NEAR, REST)

    def relabel(self, transitions: TensorDictBase, goal: torch.Tensor) -> TensorDictBase:
        return relabel_place(self, pick_reward, transitions, goal)

    def measures(self, sim: "Simulation") -> dict[str, torch.Tensor]:
        missing = sim.tensors.next_true_objects[:, :3] - sim.tensors.next_goal
        return {"cube to goal [m]": missing.norm(dim=-1)}

    def expert(self, sight: Sight) -> Aim:
        """Grasp the cube from above and bring it to the goal."""
        return fetch(sight, 0, sight.goal, **grasp_of(self.objects[0]))[0]
