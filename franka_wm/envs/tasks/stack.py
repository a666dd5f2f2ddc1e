# pyright: reportAttributeAccessIssue=false, reportIndexIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportCallIssue=false
# (Kernels are Warp's language: pyright knows neither its arrays nor its vectors.)
"""Stack: put a cube on another."""

# Warp reads annotations as types: no `from __future__ import annotations` here.
import math
from typing import TYPE_CHECKING

import torch
import warp as wp

from franka_wm.envs.constants import MOST_OPEN
from franka_wm.envs.scene import Body, Scene
from franka_wm.envs.tasks.experts import Aim, Sight, fetch, grasp_of, moved
from franka_wm.envs.tasks.manipulation import (
    GripperTask,
    effort,
    holds,
    nearness,
    place_of,
    speed_of,
    tool_of,
)

if TYPE_CHECKING:
    from franka_wm.envs.simulation import Simulation

ASIDE, OFF = 0.005, 0.005
"""How far the upper one may be off: sideways, beyond half the width of the lower one, and in height [m]."""
AWAY = 0.10
"""How far over it the hand is when all is done [m]."""
STILL = 0.01
"""It stands still where it is slower [m/s]."""


@wp.kernel(enable_backward=False)
def stack_reward_and_success(
    state: wp.array2d[float],
    joint_target: wp.array2d[float],
    objects: wp.array2d[float],
    goal: wp.array2d[float],
    action: wp.array2d[float],
    sparse: bool,
    penalty: float,
    edges: wp.vec3f,
    aside: float,
    off: float,
    still: float,
    sizes: wp.array2d[float],
    reward: wp.array2d[float],
    success: wp.array2d[wp.bool],
):
    world = wp.tid()
    cube = place_of(objects, world, 0)
    size = sizes[world, 0]
    rise = 0.5 * (edges[0] * size + edges[1] * sizes[world, 1])
    missing = place_of(objects, world, 1) + wp.vec3f(0.0, 0.0, rise) - cube
    shift = wp.length(wp.vec2f(missing[0], missing[1]))
    placed = shift <= aside * sizes[world, 1] and wp.abs(missing[2]) <= off
    away = wp.length(tool_of(state, world) - cube)
    opened = state[world, 20] + state[world, 21] > edges[2] * size + 0.004
    released = away > wp.max(edges[0], edges[2]) * size or opened
    solved = placed and released and speed_of(objects, world, 0) < still
    value = 0.2 * nearness(away)
    if holds(state, joint_target, cube, world):
        value += 0.2 + 0.3 * nearness(wp.length(missing))
    if placed:
        value = wp.where(released, 0.9, 0.8)
    if sparse or solved:
        value = wp.where(solved, 1.0, 0.0)
    reward[world, 0] = value - penalty * effort(action, world)
    success[world, 0] = solved


class Stack(GripperTask):
    """Put a cube on another and let go.

    **Scene**: a table and two cubes of 4 cm and 50 g. **Randomization**: both stand within 10 cm in x and 15 cm in y
    of (0.5, 0) m, turned by up to 45°, with 6 cm between circles around them. **Goal**: the place on top of the second
    cube at the start. **Success**: the first cube lies on the second one, off by at most half an edge and 5 mm to the
    side and 5 mm in height, slower than 1 cm/s, and the fingers have let go (ManiSkill3's StackCube: Tao et al. 2024).
    **Reward**, dense, in [0, 1]: 1 where it succeeds, 0.9 released on top, 0.8 held there; else 0.2 for the tool's
    nearness to the first cube, 1 − tanh(5 · distance), 0.2 for holding it, and then 0.3 for its nearness to its place;
    sparse: 1 where it succeeds. Both minus ``action_penalty`` · mean(action²).
    """

    scene = Scene(
        objects=(
            Body(name="cube", at=(0.5, 0.0), spread=(0.10, 0.15), turn=math.pi / 4),
            Body(name="base", at=(0.5, 0.0), spread=(0.10, 0.15), turn=math.pi / 4, color=(0.20, 0.55, 0.30)),
        ),
        space=0.06,
    )
    least_objects = 2
    words = "Put the red cube on the green one."

    def reset(self, sim: "Simulation", mask: wp.array) -> None:
        self.launch_goal(sim, mask, body=1, onto=True)

    def pose_at_goal(self, sim: "Simulation", mask: wp.array) -> None:
        """The first cube on the second, the open hand over it."""
        self.launch_goal_pose(sim, mask, tool=(0.0, 0.0, AWAY), opening=MOST_OPEN)

    def reward_and_success(self, sim: "Simulation") -> None:
        upper, lower = self.objects[:2]
        edges = wp.vec3f(2.0 * upper.half_height, 2.0 * lower.half_height, max(upper.widths))
        aside = 0.5 * min(lower.widths) + ASIDE
        self.launch_reward(sim, stack_reward_and_success, edges, aside, OFF, STILL, sim.warp.sizes)

    def measures(self, sim: "Simulation") -> dict[str, torch.Tensor]:
        return {"cube's height [m]": sim.tensors.next_true_objects[:, 2]}

    def _rise(self, sight: Sight) -> float | torch.Tensor:
        """From the middle of the lower cube to that of the upper one [m]: sizes are not observed, so it looks.

        The lower one stands on the table, the upper one is as thick as the fingers are open. One that is let go and
        lies where it can is taken to lie on the other.
        """
        ranges, scene = self.config.randomization, self.config.resolved_scene
        width, (top, bottom) = ranges.object_size, [one.half_height for one in self.objects[:2]]
        if not width or scene is None:
            return top + bottom
        if ranges.table_height:  # the height of the lower one says nothing then, the goal over it does
            return sight.goal[:, 2] - sight.body(1)[0][:, 2]
        (upper, _), (lower, _) = sight.body(0), sight.body(1)
        below = lower[:, 2] - scene.top
        lies = upper[:, 2] - lower[:, 2] - below
        half = torch.where(sight.squeezes, sight.opening + 0.001, lies)
        return below + half.clamp(top * (1 - width), top * (1 + width))

    def expert(self, sight: Sight) -> Aim:
        """Grasp the first cube from above, bring it over the second, down, let go, and up."""
        cube, _ = sight.body(0)
        spot = moved(sight.body(1)[0])
        spot[:, 2] += self._rise(sight)
        aside = (cube - spot)[:, :2].norm(dim=-1)
        high = cube[:, 2] > spot[:, 2] + 0.025
        to = torch.where((aside < 0.008)[:, None], spot, moved(spot, z=0.05))
        to[:, :2] = torch.where((high | (aside < 0.008))[:, None], spot[:, :2], cube[:, :2])
        aim, _ = fetch(sight, 0, to, **grasp_of(self.objects[0]))
        placed = (aside < 0.012) & ((cube - spot)[:, 2].abs() < 0.004)
        up = sight.target.clone()
        free = (sight.opening > 0.03) & (sight.tool[:, 2] < cube[:, 2] + 0.10)
        up[:, 2] += torch.where(free, 0.08, 0.0)
        yaw = torch.where(placed, sight.target_yaw, aim.yaw)
        opening = torch.where(placed, MOST_OPEN, aim.opening)
        return Aim(torch.where(placed[:, None], up, aim.tool), yaw, opening)
