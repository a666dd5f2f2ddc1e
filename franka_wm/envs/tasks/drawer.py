# pyright: reportAttributeAccessIssue=false, reportIndexIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportCallIssue=false
# (Kernels are Warp's language: pyright knows neither its arrays nor its vectors.)
"""Drawer: pull a drawer open by its handle."""

# Warp reads annotations as types: no `from __future__ import annotations` here.
from typing import TYPE_CHECKING

import torch
import warp as wp

from franka_wm.envs.kernels import goals
from franka_wm.envs.scene import Articulated, ArticulatedFile, Scene, Table
from franka_wm.envs.tasks.experts import Aim, Sight, fetch, moved
from franka_wm.envs.tasks.manipulation import GripperTask, effort, holds, nearness, place_of, tool_of
from franka_wm.errors import UserError

if TYPE_CHECKING:
    from franka_wm.envs.config import FrankaConfig
    from franka_wm.envs.simulation import Simulation

SHARE = 0.9
"""Share of its travel to open it by, where the config says no other opening."""


@wp.kernel(enable_backward=False)
def goal_open(
    mask: wp.array[wp.bool], bases: wp.array2d[wp.transformf], grip: wp.vec3f, goal: wp.array2d[float]
):
    world = wp.tid()
    if mask[world]:
        place = wp.transform_point(bases[world, 0], grip)
        for i in range(3):
            goal[world, i] = place[i]


@wp.kernel(enable_backward=False)
def drawer_reward_and_success(
    state: wp.array2d[float],
    joint_target: wp.array2d[float],
    objects: wp.array2d[float],
    goal: wp.array2d[float],
    action: wp.array2d[float],
    sparse: bool,
    penalty: float,
    handle: int,
    joint: int,
    enough: float,
    reward: wp.array2d[float],
    success: wp.array2d[wp.bool],
):
    world = wp.tid()
    opened = objects[world, joint]
    place = place_of(objects, world, handle)
    solved = opened >= enough
    value = 0.25 * nearness(wp.length(tool_of(state, world) - place))
    value += 0.5 * wp.clamp(opened / enough, 0.0, 1.0)
    if holds(state, joint_target, place, world):
        value += 0.25
    if sparse:
        value = wp.where(solved, 1.0, 0.0)
    reward[world, 0] = value - penalty * effort(action, world)
    success[world, 0] = solved


class Drawer(GripperTask):
    """Pull a drawer open.

    **Scene**: a chest on the table whose front looks to the robot, with one drawer of 1 kg that travels 32 cm against
    1 N of dry friction and 2 N·s/m of damping, and an upright bar of 16 mm as its handle. **Randomization**: the chest
    stands within 4 cm in x and 10 cm in y of (0.905, 0) m, turned by up to 0.2 rad (11°). **Goal**: where the handle
    is when the drawer is all open. **Success**: it is open by at least 90 % of its travel, as ManiSkill3's
    OpenCabinetDrawer asks (Tao et al. 2024; there it must also stand still). ``drawer_opening=0.3`` asks for 0.30 m,
    as Isaac Lab's Franka-Cabinet does (Mittal et al. 2023). **Reward**, dense, in [0, 1]: a quarter for the tool's
    nearness to the handle, 1 − tanh(5 · distance), a quarter for holding it, half for how far the drawer is open;
    sparse: 1 where it succeeds. Both minus ``action_penalty`` · mean(action²).
    """

    scene = Scene(
        articulated=(
            Articulated(
                name="drawer",
                size=(0.40, 0.34, 0.22),
                travel=0.32,
                at=(0.905, 0.0),
                spread=(0.04, 0.10),
                turn=0.2,
            ),
        ),
        table=Table(size=(1.5, 1.4, 0.05), at=(0.55, 0.0, 0.0)),
    )
    least_objects = 0
    own_options = ("drawer_opening",)
    words = "Open the drawer."

    @classmethod
    def check(cls, config: "FrankaConfig") -> None:
        super().check(config)
        some = config.resolved_scene.articulated if config.resolved_scene else ()
        if not some or not some[0].slides:
            raise UserError(f"scene: task={config.task} needs a drawer as the first in scene.articulated")
        if config.drawer_opening is not None and not 0 < config.drawer_opening <= some[0].travel:
            raise UserError(
                f"drawer_opening={config.drawer_opening!r}: must be above 0 and at most the travel of "
                f"scene.{some[0].name}, {some[0].travel:g} m, or null"
            )

    @property
    def drawer(self) -> Articulated | ArticulatedFile:
        """The scene's first."""
        assert self.config.resolved_scene is not None
        return self.config.resolved_scene.articulated[0]

    def reset(self, sim: "Simulation", mask: wp.array) -> None:
        w, grip = sim.warp, wp.vec3f(*self.drawer.grip_at(self.drawer.travel))
        wp.launch(goal_open, sim.num_envs, [mask, w.bases, grip, w.task_goal], device=sim.device)

    def pose_at_goal(self, sim: "Simulation", mask: wp.array) -> None:
        """The drawer all open, its handle in the hand."""
        w, drawer = sim.warp, self.drawer
        grip, joint = wp.vec3f(*drawer.grip_at(drawer.travel)), 2 + 7 * self.config.num_objects
        thick, turn = drawer.bar
        inputs = [mask, w.bases, grip, turn, joint, drawer.travel, 0.5 * thick, w.goal_rest, w.goal_hand]
        wp.launch(goals.hold_open, sim.num_envs, inputs, device=sim.device)
        assert sim.bodies is not None
        sim.bodies.launch_upright(mask)

    def reward_and_success(self, sim: "Simulation") -> None:
        c = self.config
        enough = SHARE * self.drawer.travel if c.drawer_opening is None else c.drawer_opening
        joint = c.object_dim - 2 * c.num_articulated
        self.launch_reward(sim, drawer_reward_and_success, c.num_objects, joint, enough)

    def measures(self, sim: "Simulation") -> dict[str, torch.Tensor]:
        joint = self.config.object_dim - 2 * self.config.num_articulated
        return {"opening [m]": sim.tensors.next_true_objects[:, joint]}

    def expert(self, sight: Sight) -> Aim:
        """Grasp the handle from above and pull it to where it is when the drawer is open."""
        handle = self.config.num_objects
        return fetch(sight, handle, moved(sight.goal), step=wp.pi, turn=self.drawer.bar[1])[0]
