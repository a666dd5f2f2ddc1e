# pyright: reportArgumentType=false, reportCallIssue=false
# (Warp's annotations know neither vectors nor shapes as tuples.)
"""Fingers, objects and contacts of N worlds: what they add to a step and a reset."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from franka_wm.envs.articulated_file import ArticulatedFile
from franka_wm.envs.config import FrankaConfig
from franka_wm.envs.kernels import articulated, goals
from franka_wm.envs.kernels import bodies as kernels
from franka_wm.envs.robots.gripper import PADS
from franka_wm.envs.simulation.arrays import STATISTICS

if TYPE_CHECKING:
    from franka_wm.envs.simulation.simulator import Simulation

CAPACITY = 1 | 2 | 4 | 8 | 16 | 1 << 8 | 1 << 16 | 1 << 17
"""Bits of MuJoCo's overflow that mean lost contacts, the last two Newton's; the others are of iterations that were used
up, and of what no scene has."""

RESTING = 5e-5
"""How deep an object presses into the table under its own weight [m]: it starts at rest, not in a small fall."""

SUNK = 0.02
"""An object that is this far below the table's top has left it [m]."""


def contact_options(config: FrankaConfig) -> dict[str, object]:
    """Options of Newton's MuJoCo solver, for scenes; see docs/tasks.md for what they hold."""
    scene = config.resolved_scene
    assert scene is not None
    contacts = config.max_contacts or scene.contacts(config.collisions)[1]
    meshes = any(one.shape == "mesh" for one in (*scene.objects, *scene.obstacles))
    meshes |= any(isinstance(one, ArticulatedFile) and one.mechanism.has_meshes for one in scene.articulated)
    return {
        "enable_multiccd": meshes or None,  # one contact of a mesh and a box is too few to stand on
        "use_mujoco_contacts": config.collision_pipeline == "mujoco",
        "cone": "elliptic",
        "impratio": 10.0,
        "integrator": "implicitfast",
        "nconmax": contacts,
        "njmax": 4 * contacts,
        "kinematic_switchable_roots": False,
    }


class Bodies:
    """What fingers and objects add to a step and a reset; each method only launches.

    Args:
        sim: The simulation, its arrays allocated; its config has a gripper.
    """

    def __init__(self, sim: Simulation):
        self.sim = sim
        config, device = sim.config, sim.device
        scene = config.resolved_scene
        objects = scene.objects if scene else ()

        def numbers(values: list, *shape: int) -> wp.array:
            return wp.array(values, dtype=float, device=device).reshape(shape)

        cases = scene.articulated if scene else ()
        self._count, self._joints = count, joints = len(objects), len(cases)
        blocked = scene.blocked(1.0 + config.randomization.object_size) if scene else []
        footprints = numbers([one.footprint for one in cases], joints, 4)
        obstacles = numbers(blocked, len(blocked), 7)
        space = scene.space if scene else 0.0
        self._places = [
            numbers([one.at for one in objects], count, 2),
            numbers([one.spread for one in objects], count, 2),
            numbers([one.turn for one in objects], count),
            numbers([scene.top + one.half_height - RESTING for one in objects] if scene else [], count),
            numbers([one.radius for one in objects], count),
            numbers([one.half_height for one in objects], count),
            sim.warp.sizes,
            sim.warp.raised,
            obstacles,
            space,
            sim.warp.bases,
            footprints,
        ]
        self._case_places = [
            numbers([(*one.at, one.angle) for one in cases], joints, 3),
            numbers([(*one.spread, one.turn) for one in cases], joints, 3),
            footprints,
            obstacles,
            scene.top if scene else 0.0,
            sim.warp.raised,
            space,
            count,
        ]
        self._joint_axes = [
            *(wp.array(values, dtype=wp.vec3f, device=device) for values in (
                [one.grip for one in cases], [one.hinge for one in cases], [one.axis for one in cases],
            )),
            wp.array([int(one.slides) for one in cases], dtype=int, device=device),
        ]  # fmt: skip
        self._per_step = sim.robot.finger_speed / config.fps
        self._articulations = sim.model.articulation_count // sim.num_envs
        self._mask = wp.zeros(sim.model.articulation_count, dtype=wp.bool, device=device)
        self._scene = scene
        if "goal_pixels" in config.images:
            sim.task.check_goal_image()
        if config.contact_dim:
            geoms = sim.solver.mjc_geom_to_newton_shape.numpy()[0]  # pyright: ignore[reportAttributeAccessIssue]
            names = [sim.model.shape_label[shape] if shape >= 0 else "" for shape in geoms]
            pads = [PADS.index(name) if name in PADS else -1 for name in names]
            self._finger = wp.array(pads, dtype=int, device=device)

    @property
    def layout(self) -> list[object]:
        """How many objects there are; handle, hinge and axis of each articulated body, and whether it slides."""
        return [self._count, *self._joint_axes]

    def articulation_mask(self, mask: wp.array) -> wp.array:
        """A mask of worlds as Newton's forward kinematics takes it, which counts every object as well."""
        self._launch(kernels.spread_mask, mask, self._articulations, self._mask)
        return self._mask

    def launch_grip(self, action: wp.array) -> None:
        """The command of the fingers."""
        w = self.sim.warp
        self._launch(kernels.apply_grip, action, self._per_step, w.grip, w.rest_control)

    def begin_step(self) -> None:
        """Before the physics."""
        if self._scene:
            self.sim.warp.overflow.zero_()

    def after_substep(self) -> None:
        """Notes contacts that were lost."""
        if self._scene:
            data = self.sim.solver.mjw_data  # pyright: ignore[reportAttributeAccessIssue]
            self._launch(kernels.note_overflow, data.overflow, CAPACITY, self.sim.warp.overflow)

    def launch_contacts(self) -> None:
        """Forces at the fingers, of the last substep."""
        w = self.sim.warp
        if not self.sim.config.contact_dim:
            return
        data = self.sim.solver.mjw_data  # pyright: ignore[reportAttributeAccessIssue]
        w.next_contacts.zero_()
        c = data.contact
        inputs = [data.nacon, c.worldid, c.geom, c.efc_address, data.efc.force, self._finger, w.next_contacts]
        wp.launch(kernels.add_forces, data.naconmax, inputs, device=self.sim.device)

    def launch_show_contacts(self) -> None:
        """What was felt in the step is the present observation, until a reset."""
        if self.sim.config.contact_dim:
            wp.copy(self.sim.warp.contacts, self.sim.warp.next_contacts)

    def launch_place(self, mask: wp.array) -> None:
        """New places of the masked worlds' cases and objects; their fingers are open."""
        w = self.sim.warp
        if self._joints:
            inputs = [mask, w.seed, w.episode, *self._case_places, w.bases, w.rest_q]
            self._launch(articulated.place_cases, *inputs)
        outputs = [w.rest_q, w.rest_qd, w.rest_control, w.grip, w.contacts, w.history]
        self._launch(kernels.place, mask, w.seed, w.episode, *self._places, *outputs)

    def launch_goal(self, mask: wp.array) -> None:
        """What images of the goal show of the masked worlds, whose episodes begin."""
        w = self.sim.warp
        if w.goal_rest.size:
            self._launch(goals.begin_goal, mask, w.rest_q, w.goal_rest)
            self._pose_at_goal(mask)

    def move_goal(self) -> None:
        """Images of a goal that was moved by hand: the same objects, at the new one. On torch's stream."""
        sim = self.sim
        if sim.warp.goal_rest.size:
            with sim.recorder.on_stream_of_torch():
                self._pose_at_goal(wp.ones(sim.num_envs, dtype=wp.bool, device=sim.device))

    def _pose_at_goal(self, mask: wp.array) -> None:
        assert self.sim.task.pose_at_goal is not None  # checked at the start
        self.sim.task.pose_at_goal(self.sim, mask)

    def launch_upright(self, mask: wp.array) -> None:
        """Joints of the masked worlds' goals, which put the hand at ``goal_hand``."""
        w, c = self.sim.warp, self.sim.chain
        frames = [c.parent_frames, c.child_frames, c.axes, c.tool_frame]
        inputs = [mask, w.goal_hand, c.home, c.lower, c.upper, *frames, w.origins, w.directions, w.goal_q]
        self._launch(goals.solve_upright, *inputs)

    def launch_observe(self, state: wp.array, joint_target: wp.array, objects: wp.array) -> None:
        """The hand's part of the observation, and the objects."""
        w, c = self.sim.warp, self.sim.chain
        inputs = [w.rest_q, w.rest_qd, w.body_q, c.tool_body, c.tool_frame, w.grip]
        self._launch(kernels.observe, *inputs, self._count, state, joint_target, objects)
        if self._joints:
            inputs = [w.rest_q, w.rest_qd, w.bases, *self._joint_axes, self._count]
            self._launch(articulated.observe, *inputs, objects)

    def launch_mark_nonfinite(self) -> None:
        """Before broken worlds are caught."""
        w = self.sim.warp
        self._launch(kernels.mark_nonfinite, w.rest_q, w.rest_qd, w.grip, w.next_true_state)

    def launch_restore(self) -> None:
        """After broken worlds were caught."""
        w = self.sim.warp
        last = [w.true_state, w.joint_target, w.true_objects]
        after = [w.next_true_state, w.next_joint_target, w.next_true_objects]
        self._launch(
            kernels.restore,
            w.broken,
            *last,
            self._count,
            self._joints,
            *after,
            w.rest_q,
            w.rest_qd,
            w.rest_control,
            w.grip,
            w.next_contacts,
        )

    def launch_cut_short(self) -> None:
        """Which worlds end before their time."""
        if self._scene is None:
            return
        w, table = self.sim.warp, self._scene.table
        center, half = (
            wp.vec2f(*(f * v for v in pair)) for f, pair in ((1.0, table.at[:2]), (0.5, table.size[:2]))
        )
        self._launch(
            kernels.cut_short, w.next_true_objects, self._count, w.overflow, self.sim.config.end_when_lost,
            center, half, self._scene.top - SUNK, w.raised, w.ended, STATISTICS.index("overflow"), w.cut, w.statistics,
        )  # fmt: skip

    def _launch(self, kernel: wp.Kernel, *inputs: object) -> None:
        """One thread for each world."""
        wp.launch(kernel, self.sim.num_envs, list(inputs), device=self.sim.device)
