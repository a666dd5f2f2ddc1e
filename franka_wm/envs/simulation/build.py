# pyright: reportArgumentType=false, reportCallIssue=false
# (Warp's annotations know neither vectors nor shapes as tuples.)
"""Newton's model and solver of N worlds, and what a step must know of the robot."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import newton
import torch
import warp as wp
from mujoco_warp import OverflowType

from franka_wm.envs.camera import GOAL_MARKER, GROUND, wrist_mount
from franka_wm.envs.config import FrankaConfig
from franka_wm.envs.constants import NUM_JOINTS
from franka_wm.envs.robots import SOURCES, Robot, add_robot, arm_builder
from franka_wm.envs.robots.links import add_link_colliders
from franka_wm.envs.robots.sources import detail
from franka_wm.envs.scene import FLOOR
from franka_wm.envs.simulation.bodies import contact_options
from franka_wm.envs.simulation.scene import add_scene, harden
from franka_wm.envs.tasks import Task


def build_model(
    config: FrankaConfig, task: type[Task], num_envs: int, device: str, urdf_path: str | Path | None = None
) -> tuple[newton.Model, Robot]:
    """N copies of the robot and of what the task has around it, and the ground that all of them share."""
    arm = arm_builder()
    robot = add_robot(arm, config, urdf_path)
    if config.solver == "featherstone" and config.gravity_compensation:
        arm.gravity = (0.0, 0.0, 0.0)  # it knows no compensation; nothing is there but the arm
    if config.resolved_scene:
        add_scene(arm, config.resolved_scene, robot.tool_body, detail(SOURCES[config.robot], config))
        if config.collisions != "hand":
            add_link_colliders(arm, robot, itself=config.collisions == "self")
        if config.collision_pipeline == "newton":
            arm.approximate_meshes(raise_on_failure=True)  # hulls, as MuJoCo takes them, not triangles
        harden(arm, 1.0 / (config.fps * config.substeps))
    scene = newton.ModelBuilder()
    newton.solvers.SolverMuJoCo.register_custom_attributes(scene)
    if config.show_goal:
        ghost = newton.ModelBuilder.ShapeConfig(
            has_shape_collision=False, has_particle_collision=False, density=0.0
        )
        color = (0.16, 0.58, 0.62) if config.resolved_scene else (0.90, 0.22, 0.12)  # unlike the cube's
        look: dict[str, object] = {"cfg": ghost, "color": color, "label": GOAL_MARKER}
        disc = task.disc(config)
        if disc is None:
            arm.add_shape_sphere(body=-1, radius=0.025, **look)
        else:
            arm.add_shape_cylinder(body=-1, radius=disc, half_height=0.001, **look)
    if torch.device(device).type == "cuda":
        # Warp's default there builds trees fast and traces them slowly; a robot's are built once.
        scene.default_bvh_cfg.mesh_constructor = "cubql"
    scene.replicate(arm, num_envs)
    ground = newton.ModelBuilder.ShapeConfig(has_shape_collision=False, has_particle_collision=False)
    # The arm stands on the table, where there is one, and that on the floor.
    scene.add_ground_plane(height=FLOOR if config.resolved_scene else 0.0, cfg=ground, color=GROUND)
    return scene.finalize(device=device), robot


def make_solver(model: newton.Model, config: FrankaConfig) -> newton.solvers.SolverBase:
    """The physics that ``config.solver`` names; MuJoCo's steps a state in place, Featherstone's from one to another."""
    if config.solver == "featherstone":
        return newton.solvers.SolverFeatherstone(model)
    options = contact_options(config) if config.resolved_scene else {"disable_contacts": True}
    solver = newton.solvers.SolverMuJoCo(
        model,
        iterations=config.solver_iterations,
        ls_iterations=config.solver_ls_iterations,
        disable_sensors=True,
        **options,
    )
    # Kernels print neither: overflow in a scene is counted, and a line search may use all of solver_ls_iterations.
    quiet = OverflowType.ALL if config.resolved_scene else OverflowType.LS_ITERATIONS
    solver.mjw_model.opt.warn_overflow = int(solver.mjw_model.opt.warn_overflow & ~quiet)
    return solver


@dataclass(frozen=True)
class Chain:
    """The robot as kernels read it; nothing here ever changes.

    Attributes:
        home: (7,) joint angles at the start of an episode, before noise [rad].
        lower, upper: (7,) joint limits [rad].
        lead: (7,) how far a set point may be ahead of its joint [rad]; without a speed limit, as far as it likes.
        parent_frames, child_frames: (7,) transforms, each joint's frame in its parent link and in its own.
        axes: (7,) vectors, each joint's axis in its frame.
        tool_frame: (1,) transform, the tool in the link that carries it.
        tool_body: That link's index among the bodies of a world.
        mount: (1,) transform, the wrist camera in that link.
    """

    home: wp.array
    lower: wp.array
    upper: wp.array
    lead: wp.array
    parent_frames: wp.array
    child_frames: wp.array
    axes: wp.array
    tool_frame: wp.array
    tool_body: int
    mount: wp.array

    @classmethod
    def of(cls, robot: Robot, config: FrankaConfig, device: str) -> Chain:
        """The chain of ``robot`` on ``device``."""

        def numbers(values) -> wp.array:
            return wp.array(values, dtype=float, device=device)

        def frames(values) -> wp.array:
            return wp.array(values, dtype=wp.transformf, device=device)

        return cls(
            home=numbers(config.start_pose),
            lower=numbers(robot.lower),
            upper=numbers(robot.upper),
            lead=numbers(_lead(robot, config)),
            parent_frames=frames(robot.parent_frames),
            child_frames=frames(robot.child_frames),
            axes=wp.array(robot.axes, dtype=wp.vec3f, device=device),
            tool_frame=frames(robot.tool_frame.reshape(1, 7)),
            tool_body=robot.tool_body,
            mount=frames([wrist_mount(robot.tool_frame)]),
        )


def _lead(robot: Robot, config: FrankaConfig) -> list[float]:
    """How far a set point may be ahead of each joint [rad]: at kd·v/ke the servo does not push a joint beyond v."""
    if not config.limit_velocity:
        return [1e6] * NUM_JOINTS
    ke, kd = config.gains("target_ke"), config.gains("target_kd")
    return [d * float(v) / k for k, d, v in zip(ke, kd, robot.velocity_limit, strict=True)]
