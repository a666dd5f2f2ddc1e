# pyright: reportArgumentType=false, reportCallIssue=false
# (Warp's annotations know neither vectors nor shapes as tuples.)
"""Fingers, objects and contacts of N worlds: how they get into the model, and what they add to a step and a reset."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import newton
import warp as wp

from franka_wm.envs.config import FrankaConfig
from franka_wm.envs.kernels import bodies as kernels
from franka_wm.envs.robots.gripper import add_colliders
from franka_wm.envs.scene import Scene, Solid
from franka_wm.envs.simulation.arrays import STATISTICS
from franka_wm.errors import UserError

if TYPE_CHECKING:
    from franka_wm.envs.simulation.simulator import Simulation

SOLREF, SOLIMP = (0.02, 1.0), (0.95, 0.99, 0.001, 0.5, 2.0)
"""How stiff contacts are, as MuJoCo says it: 0.7 mm of penetration where 20 N hold a 4 cm cube of 50 g."""

CAPACITY = 1 | 2 | 4 | 8 | 16 | 1 << 16 | 1 << 17
"""Bits of MuJoCo's overflow that mean lost contacts; the others say that iterations were used up."""

RESTING = 5e-5
"""How deep an object presses into the table under its own weight [m]: it starts at rest, not in a small fall."""

SUNK = 0.02
"""An object that is this far below the table's top has left it [m]."""


def add_scene(builder: newton.ModelBuilder, scene: Scene, tool_body: int) -> None:
    """Adds everything that can be touched to a builder that holds one world's arm, the fingers' boxes included.

    Args:
        builder: Its arm compensated for gravity already: objects are not.
        scene: What stands there.
        tool_body: The link that carries the hand.
    """
    for shape in add_colliders(builder, tool_body):
        _harden(builder, shape)
    for one in (scene.table, *scene.obstacles):
        x, y, z = one.at
        if one is scene.table:
            z -= one.half_height
        turn = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), one.angle)
        _add_shape(builder, -1, one, density=0.0, at=wp.transform(wp.vec3(x, y, z), turn))
    for one in scene.objects:
        at = wp.transform(wp.vec3(*one.at, scene.top + one.half_height), wp.quat_identity())
        body = builder.add_body(xform=at, label=one.name)
        _add_shape(builder, body, one, density=one.mass / one.volume, at=wp.transform_identity())


def _add_shape(
    builder: newton.ModelBuilder, body: int, solid: Solid, *, density: float, at: wp.transform
) -> None:
    config = newton.ModelBuilder.ShapeConfig(
        density=density, mu=solid.friction, gap=0.0, has_particle_collision=False
    )
    more: dict[str, Any] = {"xform": at, "cfg": config, "color": solid.color, "label": solid.name}
    size = solid.size
    if solid.shape == "box":
        hx, hy, hz = (0.5 * s for s in size)
        shape = builder.add_shape_box(body, hx=hx, hy=hy, hz=hz, **more)
    elif solid.shape == "sphere":
        shape = builder.add_shape_sphere(body, radius=size[0], **more)
    elif solid.shape == "cylinder":
        shape = builder.add_shape_cylinder(body, radius=size[0], half_height=0.5 * size[1], **more)
    else:
        shape = builder.add_shape_capsule(body, radius=size[0], half_height=0.5 * size[1], **more)
    _harden(builder, shape)


def _harden(builder: newton.ModelBuilder, shape: int) -> None:
    """MuJoCo's contact parameters of one shape, as they are: Newton would make others of stiffness and damping."""
    values = {
        "mujoco:condim": 3,
        "mujoco:geom_solimp": wp.types.vector(length=5, dtype=wp.float32)(*SOLIMP),
        "mujoco:solref": wp.vec2(*SOLREF),
        "mujoco:solref_mode": 1,
    }
    for name, value in values.items():
        attribute = builder.custom_attributes[name]
        if attribute.values is None:
            attribute.values = {}
        attribute.values[shape] = value


def room_for_contacts(config: FrankaConfig) -> int:
    """Contacts per world for which there is room: what the config says, or enough for the scene.

    The hand rammed into a table and a cube makes 14. All worlds share one pool of this many each, so a crowded world
    takes from others' share before anything is lost.

    Raises:
        UserError: The config allows fewer than the scene needs to stand still.
    """
    scene = config.surroundings
    assert scene is not None
    objects, obstacles = len(scene.objects), len(scene.obstacles)
    least = 8 + 4 * objects
    wanted = 8 + 16 * objects + 4 * obstacles + 2 * objects * (objects - 1)
    if config.max_contacts is None:
        return wanted
    if config.max_contacts < least:
        raise UserError(
            f"max_contacts={config.max_contacts}: this scene needs at least {least} (4 under each object, 8 for the "
            f"hand); {wanted} are enough, which null means"
        )
    return config.max_contacts


def contact_options(config: FrankaConfig) -> dict[str, Any]:
    """Of Newton's MuJoCo solver, for scenes; see docs/tasks.md for what they hold."""
    contacts = room_for_contacts(config)
    return {
        "use_mujoco_contacts": True,
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
        scene = config.surroundings
        objects = scene.objects if scene else ()

        def numbers(values: list, *shape: int) -> wp.array:
            return wp.array(values, dtype=float, device=device).reshape(shape)

        count = len(objects)
        blocked = scene.blocked() if scene else []
        self._places = [
            numbers([one.at for one in objects], count, 2),
            numbers([one.spread for one in objects], count, 2),
            numbers([one.turn for one in objects], count),
            numbers([scene.top + one.half_height - RESTING for one in objects] if scene else [], count),
            numbers([one.radius for one in objects], count),
            numbers(blocked, len(blocked), 7),
            scene.space if scene else 0.0,
        ]
        self._per_step = sim.robot.finger_speed / config.fps
        self._articulations = sim.model.articulation_count // sim.num_envs
        self._mask = wp.zeros(sim.model.articulation_count, dtype=wp.bool, device=device)
        self._scene = scene
        if config.contact_dim:
            geoms = sim.solver.mjc_geom_to_newton_shape.numpy()[0]  # pyright: ignore[reportAttributeAccessIssue]
            names = [sim.model.shape_label[shape] if shape >= 0 else "" for shape in geoms]
            pads = [int(name[-1]) if name in ("pad0", "pad1") else -1 for name in names]
            self._finger = wp.array(pads, dtype=int, device=device)

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
        """New places of the masked worlds' objects; their fingers are open."""
        w = self.sim.warp
        outputs = [w.rest_q, w.rest_qd, w.rest_control, w.grip, w.contacts, w.history]
        self._launch(kernels.place, mask, w.seed, w.episode, *self._places, *outputs)

    def launch_observe(self, state: wp.array, joint_target: wp.array, objects: wp.array) -> None:
        """The hand's part of the observation, and the objects."""
        w, c = self.sim.warp, self.sim.chain
        inputs = [w.rest_q, w.rest_qd, w.body_q, c.tool_body, c.tool_frame, w.grip]
        self._launch(kernels.observe, *inputs, state, joint_target, objects)

    def launch_mark_nonfinite(self) -> None:
        """Before broken worlds are caught."""
        w = self.sim.warp
        self._launch(kernels.mark_nonfinite, w.rest_q, w.rest_qd, w.grip, w.next_true_state)

    def launch_restore(self) -> None:
        """After broken worlds were caught."""
        w = self.sim.warp
        last = [w.true_state, w.joint_target, w.objects]
        after = [w.next_true_state, w.next_joint_target, w.next_objects]
        self._launch(
            kernels.restore,
            w.broken,
            *last,
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
            kernels.cut_short, w.next_objects, w.overflow, self.sim.config.end_when_lost, center, half,
            self._scene.top - SUNK, w.ended, STATISTICS.index("overflow"), w.cut, w.statistics,
        )  # fmt: skip

    def _launch(self, kernel: wp.Kernel, *inputs: Any) -> None:
        """One thread for each world."""
        wp.launch(kernel, self.sim.num_envs, list(inputs), device=self.sim.device)
