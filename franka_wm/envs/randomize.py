# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false, reportAttributeAccessIssue=false
# pyright: reportArgumentType=false
# (Warp's annotations do not say what a built model always has.)
"""What each episode of each world draws anew: looks, servo, joints, links, objects, contacts, delay."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp
from newton import ModelFlags

from franka_wm.envs.camera import camera_framing
from franka_wm.envs.kernels import randomization as kernels

if TYPE_CHECKING:
    from franka_wm.envs.simulation import Simulation


class Randomizer:
    """Draws for the masked worlds at every reset, inside the captured graph.

    Most drawn values live in the Newton model's own arrays, which hold one row for each world; MuJoCo's copy of
    the physical ones is refreshed: on the CPU in steps in which some world is reset, on CUDA in every step. Contacts'
    friction, and the sizes and heights that contacts meet, are in MuJoCo's arrays alone.

    Args:
        sim: The simulation; its config says what is drawn.
    """

    def __init__(self, sim: Simulation):
        self.sim = sim
        self.ranges = sim.config.randomization
        model, n = sim.model, sim.num_envs
        self._drawn: list[wp.array] = []
        if self.ranges.color:
            worlds = model.shape_world.numpy()
            first = int(np.argmax(worlds == 0))
            self._shapes = int((worlds == 0).sum())
            colors = model.shape_color[first : first + n * self._shapes].reshape((n, self._shapes))
            self._colors, self._plain_colors = colors, wp.clone(colors)
        else:
            self._shapes = 0
            self._colors = self._plain_colors = wp.zeros((n, 1), dtype=wp.vec3f, device=sim.device)
        if self.ranges.dynamics:

            def per_world(array: wp.array) -> wp.array:
                return array.reshape((n, array.shape[0] // n))

            self._physical = [
                per_world(a)
                for a in (
                    model.joint_target_ke, model.joint_target_kd, model.joint_armature, model.joint_friction,
                    model.body_mass, model.body_inertia,
                )
            ]  # fmt: skip
            ke, kd, armature, _, mass, inertia = (wp.clone(a) for a in self._physical)
            self._plain = [ke, kd, armature, mass, inertia]
            self._limits = per_world(model.joint_effort_limit)
            self._plain_limits = wp.clone(self._limits)
            self._any = wp.zeros(1, dtype=int, device=sim.device)

        if self.ranges.object_size:
            self._note_sizes()
        if self.ranges.table_height:
            self._note_table()
        if self.ranges.contact_friction:  # MuJoCo's own, which nothing else writes
            self._frictions = sim.solver.mjw_model.geom_friction
            self._plain_frictions = wp.clone(self._frictions)

    def arrays(self) -> list[wp.array]:
        """What is drawn, each (N, …), besides what the simulation lists itself."""
        r = self.ranges
        out = [self._colors] if r.color else []
        out += self._physical if r.dynamics else []
        out += [self._limits] if r.grip_force else []
        return out + ([self._frictions] if r.contact_friction else [])

    def _note_sizes(self) -> None:
        """Where the objects' sizes are, and what they are."""
        sim, n = self.sim, self.sim.num_envs
        model, mujoco = sim.model, sim.solver.mjw_model
        shapes = int((model.shape_world.numpy() == 0).sum())
        start = int(np.argmax(model.shape_world.numpy() == 0))
        bodies = model.shape_body.numpy()
        first = model.body_label.index(sim.config.resolved_scene.objects[0].name)
        self._first_object = first
        parts = []
        for geom, shape in enumerate(sim.solver.mjc_geom_to_newton_shape.numpy()[0]):
            number = int(bodies[shape]) - first
            if shape >= 0 and 0 <= number < sim.config.num_objects:
                parts.append((geom, int(shape) - start, number))
        self._parts = wp.array(parts, dtype=wp.vec3i, device=sim.device)
        touched = [getattr(mujoco, f"geom_{name}") for name in ("size", "aabb", "rbound", "pos")]
        seen = [
            array[start : start + n * shapes].reshape((n, shapes))
            for array in (model.shape_scale, model.shape_transform)
        ]
        coms = model.body_com.reshape((n, -1))
        self._sized = [*touched, *seen, coms]
        self._plain_sizes = [wp.clone(array)[0] for array in touched] + [
            wp.clone(array) for array in (*seen, coms)
        ]

    def _note_table(self) -> None:
        """Where table and obstacles are."""
        sim, n = self.sim, self.sim.num_envs
        model, scene = sim.model, sim.config.resolved_scene
        worlds, bodies = model.shape_world.numpy(), model.shape_body.numpy()
        start, shapes = int(np.argmax(worlds == 0)), int((worlds == 0).sum())
        geoms = sim.solver.mjc_geom_to_newton_shape.numpy()[0].tolist()
        names = {one.name for one in (scene.table, *scene.obstacles)}
        still = [
            shape
            for shape in range(start, start + shapes)
            if bodies[shape] < 0 and model.shape_label[shape] in names
        ]
        parts = [(shape - start, geoms.index(shape) if shape in geoms else -1) for shape in still]
        self._still = wp.array(parts, dtype=wp.vec2i, device=sim.device)
        frames = model.shape_transform[start : start + n * shapes].reshape((n, shapes))
        self._places = [sim.solver.mjw_data.geom_xpos, frames]
        self._plain_places = [wp.clone(array) for array in self._places]

    def launch(self, mask: wp.array) -> None:
        """Draws for the masked worlds."""
        sim, r, w = self.sim, self.ranges, self.sim.warp
        if r.color or r.brightness or r.camera_position or r.camera_target or r.action_latency:
            eye, at = (wp.vec3f(*point) for point in camera_framing(sim.config))
            wp.launch(
                kernels.draw_looks,
                sim.num_envs,
                [
                    mask, w.seed, w.episode, r.color, r.brightness, eye, at, r.camera_position, r.camera_target,
                    r.action_latency, self._shapes, self._plain_colors, self._colors, w.brightness, w.poses, w.delay,
                ],
                device=sim.device,
            )  # fmt: skip
        known = [mask, w.seed, w.episode]
        if r.contact_friction:
            inputs = [*known, r.contact_friction, self._plain_frictions, self._frictions]
            wp.launch(kernels.draw_frictions, sim.num_envs, inputs, device=sim.device)
        if r.table_height:
            inputs = [*known, r.table_height, w.raised]
            wp.launch(kernels.draw_table, sim.num_envs, inputs, device=sim.device)
            self._raise_table()
        if r.grip_force:
            inputs = [
                *known,
                r.grip_force,
                self._plain[0],
                self._plain_limits,
                self._physical[0],
                self._limits,
            ]
            wp.launch(kernels.draw_grip, sim.num_envs, inputs, device=sim.device)
        if r.dynamics:
            wp.launch(
                kernels.draw_dynamics,
                sim.num_envs,
                [
                    mask, w.seed, w.episode, r.gains, r.armature, r.friction, r.mass, *self._plain, *self._physical
                ],
                device=sim.device,
            )  # fmt: skip
            if r.object_size:
                inputs = [*known, r.object_size, self._first_object, w.sizes, *self._physical[4:]]
                wp.launch(kernels.draw_sizes, sim.num_envs, inputs, device=sim.device)
            if wp.get_device(sim.device).is_cuda:
                # A conditional part of a CUDA graph must not allocate, which MuJoCo's refresh does; the values of
                # worlds that are not reset are the ones that they had.
                self.apply()
                return
            self._any.zero_()
            wp.launch(kernels.any_masked, sim.num_envs, [mask, self._any], device=sim.device)
            wp.capture_if(self._any, self.apply)

    def apply(self) -> None:
        """Hands the physical values to MuJoCo."""
        sim = self.sim
        if self.ranges.table_height:
            self._raise_table()
        if self.ranges.object_size:
            inputs = [sim.warp.sizes, self._parts, *self._plain_sizes, self._first_object, *self._sized]
            wp.launch(kernels.resize, (sim.num_envs, len(self._parts)), inputs, device=sim.device)
        if self.ranges.dynamics:
            # Of armatures and masses MuJoCo computes its constants anew.
            flags = ModelFlags.JOINT_DOF_FORCE_PROPERTIES
            if self.ranges.armature:
                flags |= ModelFlags.JOINT_DOF_INERTIAL_PROPERTIES
            if self.ranges.inertial:
                flags |= ModelFlags.BODY_INERTIAL_PROPERTIES
            sim.solver.notify_model_changed(flags)

    def _raise_table(self) -> None:
        """Puts table and obstacles at their heights, in all worlds."""
        sim = self.sim
        inputs = [sim.warp.raised, self._still, *self._plain_places, *self._places]
        wp.launch(kernels.raise_table, (sim.num_envs, len(self._still)), inputs, device=sim.device)
