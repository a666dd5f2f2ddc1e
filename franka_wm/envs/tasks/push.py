# pyright: reportAttributeAccessIssue=false, reportIndexIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportCallIssue=false
# (Kernels are Warp's language: pyright knows neither its arrays nor its vectors.)
"""Push: slide a cube onto a disc."""

# Warp reads annotations as types: no `from __future__ import annotations` here.
import math
from typing import TYPE_CHECKING

import torch
import warp as wp
from tensordict import TensorDictBase

from franka_wm.envs.scene import REACH, Body, Scene
from franka_wm.envs.tasks.experts import Aim, Sight, moved
from franka_wm.envs.tasks.manipulation import (
    GripperTask,
    effort,
    first_of_episode,
    near_in_torch,
    nearness,
    place_of,
    relabel_place,
    tool_of,
)
from franka_wm.errors import UserError

if TYPE_CHECKING:
    from franka_wm.envs.config import FrankaConfig
    from franka_wm.envs.simulation import Simulation

AHEAD = 0.20
"""The disc's middle is so far in front of the cube, plus or minus ``disc_spread`` [m]."""
BEHIND = 0.035
"""Where the fingers push: so far behind the cube's centre [m]."""


@wp.kernel(enable_backward=False)
def push_reward_and_success(
    state: wp.array2d[float],
    joint_target: wp.array2d[float],
    objects: wp.array2d[float],
    goal: wp.array2d[float],
    action: wp.array2d[float],
    sparse: bool,
    penalty: float,
    radius: float,
    behind: float,
    reward: wp.array2d[float],
    success: wp.array2d[wp.bool],
):
    world = wp.tid()
    cube = place_of(objects, world, 0)
    missing = wp.length(wp.vec2f(goal[world, 0] - cube[0], goal[world, 1] - cube[1]))
    flat = wp.abs(cube[2] - goal[world, 2]) < 0.005
    solved = missing < radius and flat
    ready = nearness(wp.length(tool_of(state, world) - (cube - wp.vec3f(behind, 0.0, 0.0))))
    value = 0.3 * ready + 0.5 * nearness(missing) * wp.where(flat, 1.0, 0.0)
    if solved:
        value = 0.8 + 0.2 * nearness(missing)
    if sparse:
        value = wp.where(solved, 1.0, 0.0)
    reward[world, 0] = value - penalty * effort(action, world)
    success[world, 0] = solved


class Push(GripperTask):
    """Push a cube onto a disc.

    **Scene**: a table and a cube of 4 cm and 50 g. **Randomization**: the cube stands within 7 cm in x and 15 cm in y
    of (0.42, 0) m. **Goal**: the middle of a disc of 10 cm radius (``disc_radius``), 20 cm in front of where the cube
    stood, ``disc_spread`` more or less. **Success**: the cube lies on the table with its centre on the disc
    (ManiSkill3's PushCube: Tao et al. 2024). **Reward**, dense, in [0, 1]: on the disc 0.8 to 1, by the distance to its
    middle; else 0.3 for the tool's nearness to where it can push, 1 − tanh(5 · distance), and half for the cube's to
    the goal; sparse: 1 where it succeeds. Both minus ``action_penalty`` · mean(action²).
    """

    scene = Scene(objects=(Body(name="cube", at=(0.42, 0.0), spread=(0.07, 0.15)),))
    grasps = False
    marker = 0.1
    own_options = ("disc_radius", "disc_spread")
    words = "Push the cube onto the disc."
    relabel_reads = ("state", "joint_target", "objects")
    achieved = ("objects", slice(0, 3))

    @classmethod
    def check(cls, config: "FrankaConfig") -> None:
        super().check(config)
        assert config.resolved_scene is not None
        cube, table = config.resolved_scene.objects[0], config.resolved_scene.table
        x = cube.at[0] + cube.spread[0] + AHEAD + config.disc_spread
        far, edge = math.hypot(x, abs(cube.at[1]) + cube.spread[1]), table.at[0] + 0.5 * table.size[0]
        if far > REACH[1] or x + cube.radius > edge:
            raise UserError(
                f"scene.{cube.name}: task={config.task} asks for a place {AHEAD + config.disc_spread:g} m ahead of it, "
                f"{far:.2f} m from the base; the arm reaches {REACH[1]:g} m, the table ends at x = {edge:g} m: change "
                "at, spread or disc_spread"
            )

    def reset(self, sim: "Simulation", mask: wp.array) -> None:
        self.launch_goal(sim, mask, away=(AHEAD, 0.0, 0.0), spread=self.config.disc_spread)

    def goal_was_set(self, sim: "Simulation") -> None:
        """The goal is a place of the lying cube: its height is not for anyone to choose."""
        t, scene = sim.tensors, self.config.resolved_scene
        assert scene is not None
        t.task_goal[:, 2] = scene.top + t.raised + t.sizes[:, 0] * self.objects[0].half_height

    def pose_at_goal(self, sim: "Simulation", mask: wp.array) -> None:
        """The cube in the middle of the disc, the closed fingers behind it."""
        self.launch_goal_pose(sim, mask, tool=(-BEHIND, 0.0, 0.0), opening=0.0, turned=False)

    def reward_and_success(self, sim: "Simulation") -> None:
        self.launch_reward(sim, push_reward_and_success, self.config.disc_radius, BEHIND)

    def in_torch(
        self, state: torch.Tensor, _: torch.Tensor, objects: torch.Tensor, goal: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """The same, see :data:`~franka_wm.envs.tasks.manipulation.RewardInTorch`."""
        cube = objects[..., :3]
        missing = (goal - cube)[..., :2].norm(dim=-1)
        flat = (cube[..., 2] - goal[..., 2]).abs() < 0.005
        solved = (missing < self.config.disc_radius) & flat
        ready = near_in_torch((state[..., 14:17] - moved(cube, x=-BEHIND)).norm(dim=-1))
        value = 0.3 * ready + 0.5 * near_in_torch(missing) * flat
        return torch.where(solved, 0.8 + 0.2 * near_in_torch(missing), value), solved

    def relabel(self, transitions: TensorDictBase, goal: torch.Tensor) -> TensorDictBase:
        # Where the cube was it may have been tilted; as in goal_was_set, the goal keeps the height of a lying one.
        state = first_of_episode(transitions)
        lying = torch.cat([goal[:, :2], state[:, 16:17] - state[:, 19:20]], -1)
        return relabel_place(self, self.in_torch, transitions, lying)

    def measures(self, sim: "Simulation") -> dict[str, torch.Tensor]:
        way = sim.tensors.next_true_objects[:, :2] - sim.tensors.next_goal[:, :2]
        return {"cube to disc [m]": way.norm(dim=-1)}

    def expert(self, sight: Sight) -> Aim:
        """Closed fingers down behind the cube, then forward with it."""
        cube, _ = sight.body(0)
        away = cube - sight.tool
        behind = (away[:, 0] > BEHIND - 0.015) & (away[:, 0] < BEHIND + 0.04) & (away[:, 1].abs() < 0.015)
        low = away[:, 2].abs() < 0.015
        start = moved(cube, x=-BEHIND - 0.02)
        over = (start - sight.tool)[:, :2].norm(dim=-1) < 0.015
        start[:, 2] += torch.where(over | (behind & low), 0.0, 0.08)
        onward = torch.stack([sight.goal[:, 0] - BEHIND, cube[:, 1], cube[:, 2]], -1)
        done = cube[:, 0] > sight.goal[:, 0] - 0.02
        tool = torch.where((behind & low)[:, None], onward, start)
        tool = torch.where(done[:, None], sight.target, tool)
        return Aim(tool, torch.zeros_like(sight.yaw), torch.zeros_like(sight.yaw))
