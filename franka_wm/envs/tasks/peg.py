# pyright: reportAttributeAccessIssue=false, reportIndexIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportCallIssue=false
# (Kernels are Warp's language: pyright knows neither its arrays nor its vectors.)
"""Peg: put a peg into a hole."""

# Warp reads annotations as types: no `from __future__ import annotations` here.
import math
from typing import TYPE_CHECKING

import torch
import warp as wp

from franka_wm.envs.scene import Body, Scene
from franka_wm.envs.solids import PLATE
from franka_wm.envs.tasks.experts import Aim, Sight, fetch, quarter_turn
from franka_wm.envs.tasks.manipulation import (
    GripperTask,
    effort,
    holds,
    nearness,
    place_of,
    rotation_of,
    tool_of,
)
from franka_wm.errors import UserError

if TYPE_CHECKING:
    from franka_wm.envs.config import FrankaConfig
    from franka_wm.envs.simulation import Simulation

THICK, CLEARANCE = 0.030, 0.003
"""Thickness of the peg, and gap between it and the hole on each side [m]."""
DEEP, GRIP = wp.constant(0.015), wp.constant(0.015)
"""How deep the peg must be in the hole, at least; how far over its middle it is grasped [m]."""


@wp.func
def end_in_hole(objects: wp.array2d[float], world: int, halves: wp.vec3f) -> wp.vec3f:
    """The peg's lower end in the frame of the hole's mouth [m]."""
    down = wp.quat_rotate(rotation_of(objects, world, 0), wp.vec3f(0.0, 0.0, -halves[0]))
    away = place_of(objects, world, 0) + down - place_of(objects, world, 1)
    return wp.quat_rotate_inv(rotation_of(objects, world, 1), away) - wp.vec3f(0.0, 0.0, halves[1])


@wp.kernel(enable_backward=False)
def peg_reward_and_success(
    state: wp.array2d[float],
    joint_target: wp.array2d[float],
    objects: wp.array2d[float],
    goal: wp.array2d[float],
    action: wp.array2d[float],
    sparse: bool,
    penalty: float,
    halves: wp.vec3f,
    reward: wp.array2d[float],
    success: wp.array2d[wp.bool],
):
    world = wp.tid()
    end = end_in_hole(objects, world, halves)
    inside = wp.max(wp.abs(end[0]), wp.abs(end[1])) < halves[2]
    solved = inside and end[2] <= -DEEP
    at = place_of(objects, world, 0) + wp.vec3f(0.0, 0.0, GRIP)
    value = 0.2 * nearness(wp.length(tool_of(state, world) - at))
    if holds(state, joint_target, at, world):
        value += 0.2 + 0.3 * nearness(wp.length(end))
    if inside and end[2] < 0.0:
        value = 0.7 + 0.2 * wp.min(-end[2] / DEEP, 1.0)
    if sparse or solved:
        value = wp.where(solved, 1.0, 0.0)
    reward[world, 0] = value - penalty * effort(action, world)
    success[world, 0] = solved


class Peg(GripperTask):
    """Put a peg into a hole.

    **Scene**: a table, a square peg of 3 cm and 10 cm that stands upright, 50 g, and a block of 9 cm, 4 cm high, 2 kg,
    with a square hole from above, 3 mm wider than the peg on each side. Both move freely. **Randomization**: both
    stand within 10 cm in x and 15 cm in y of (0.5, 0) m, turned by up to 45°, with 6 cm between circles around them.
    **Goal**: the peg's middle when it stands in the hole. **Success**: the peg's lower end is inside the hole, at
    least 15 mm deep (ManiSkill3's PegInsertionSide: Tao et al. 2024, with its clearance and depth; its hole is in the
    block's side, and its peg lies). **Reward**, dense, in [0, 1]: 1 where it succeeds, 0.7 to 0.9 in the hole, by the
    depth; else 0.2 for the tool's nearness to where it grasps the peg, 1 − tanh(5 · distance), 0.2 for holding it, and
    then 0.3 for its lower end's nearness to the hole; sparse: 1 where it succeeds. Both minus ``action_penalty`` ·
    mean(action²).
    """

    scene = Scene(
        objects=(
            Body(name="peg", size=(THICK, THICK, 0.10), at=(0.5, 0.0), spread=(0.10, 0.15), turn=math.pi / 4),
            Body(
                name="block", shape="socket", size=(0.09, THICK + 2 * CLEARANCE, 0.04), mass=2.0, at=(0.5, 0.0),
                spread=(0.10, 0.15), turn=math.pi / 4, color=(0.25, 0.38, 0.62),
            ),
        ),
        space=0.06,
    )  # fmt: skip
    least_objects = 2
    words = "Put the peg into the hole."

    @classmethod
    def check(cls, config: "FrankaConfig") -> None:
        super().check(config)
        assert config.resolved_scene is not None
        peg, block = config.resolved_scene.objects[:2]
        if block.shape != "socket" or max(peg.widths) >= block.size[1] or block.size[2] - PLATE < DEEP:
            what = "a shape=socket as the second in scene.objects, with room for the first"
            raise UserError(f"scene: task={config.task} needs {what}, {DEEP:g} m deep")
        if config.randomization.object_size:
            raise UserError("randomization.object_size: the peg would not fit its hole; set it to 0")

    def _halves(self) -> tuple[float, float, float]:
        """Half of the peg's and the block's height, and of the hole's width [m]."""
        peg, block = self.objects[:2]
        return peg.half_height, block.half_height, 0.5 * block.size[1]

    def reset(self, sim: "Simulation", mask: wp.array) -> None:
        peg, block, _ = self._halves()
        self.launch_goal(sim, mask, body=1, away=(0.0, 0.0, peg - block + PLATE))

    def pose_at_goal(self, sim: "Simulation", mask: wp.array) -> None:
        """The peg in the hole, still in the hand."""
        self.launch_goal_pose(sim, mask, tool=(0.0, 0.0, GRIP), like=1)

    def reward_and_success(self, sim: "Simulation") -> None:
        self.launch_reward(sim, peg_reward_and_success, wp.vec3f(*self._halves()))

    def measures(self, sim: "Simulation") -> dict[str, torch.Tensor]:
        away = sim.tensors.next_true_objects[:, :3] - sim.tensors.next_goal
        return {"peg to its place [m]": away.norm(dim=-1)}

    def expert(self, sight: Sight) -> Aim:
        """Grasp the peg over its middle, bring it over the hole, turn it, and down."""
        (peg, angle), (block, hole) = sight.body(0), sight.body(1)
        turn = quarter_turn(hole - angle, torch.zeros_like(angle))
        aside = (peg - block)[:, :2].norm(dim=-1)
        clear = block[:, 2] + sum(self._halves()[:2])  # the peg's middle as it would stand on the block
        within = peg[:, 2] < clear - 0.002
        aligned = (aside < 0.002) & (turn.abs() < 0.03) | (aside < 0.005) & within
        high = peg[:, 2] > clear + 0.01
        near = (high | aligned | within & (aside < 0.01))[:, None]
        to = torch.cat([torch.where(near, block[:, :2], peg[:, :2]), (clear + 0.02)[:, None]], -1)
        to[:, 2] = torch.where(aligned, sight.goal[:, 2], to[:, 2])
        aim, held = fetch(sight, 0, to, grip=GRIP)  # what lags behind is not added up, as fetch would
        tool = torch.where(held[:, None], sight.tool + to - peg, aim.tool)
        return Aim(tool, torch.where(held, sight.yaw + turn, aim.yaw), aim.opening)
