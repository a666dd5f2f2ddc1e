# pyright: reportArgumentType=false, reportCallIssue=false
# (Warp's annotations know neither vectors nor shapes as tuples.)
"""What can be touched, in Newton's builder: fingers, table, objects, obstacles, drawers, doors, bodies from files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import newton
import numpy as np
import warp as wp
from scipy.spatial import ConvexHull

from franka_wm.envs.articulated import Articulated
from franka_wm.envs.articulated_file import ArticulatedFile
from franka_wm.envs.mechanisms import Mechanism, Part, Point
from franka_wm.envs.mesh_solids import MOST_CORNERS, Surface
from franka_wm.envs.robots.gripper import add_colliders
from franka_wm.envs.robots.meshes import Piece, simplify
from franka_wm.envs.scene import Scene, Solid
from franka_wm.envs.solids import Box

SOLREF, SOLIMP = (0.02, 1.0), (0.95, 0.99, 0.001, 0.5, 2.0)
"""How stiff contacts are, as MuJoCo says it: 0.7 mm of penetration where 20 N hold a 4 cm cube of 50 g."""

STEPS = 2.4
"""Least time constant of a contact, in steps of the physics; MuJoCo takes no less than two."""


def add_scene(builder: newton.ModelBuilder, scene: Scene, tool_body: int, cell: float) -> None:
    """Adds everything that can be touched to a builder that holds one world's arm, the fingers' boxes included.

    Args:
        builder: Its arm compensated for gravity already: objects are not.
        scene: What stands there.
        tool_body: The link that carries the hand.
        cell: Details of meshes smaller than this are not drawn [m].
    """
    add_colliders(builder, tool_body)
    still = []
    for one in (scene.table, *scene.obstacles):
        x, y, z = one.at
        if one is scene.table:
            z -= one.half_height
        turn = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), one.angle)
        still += _add_shape(builder, -1, one, density=0.0, at=wp.transform(wp.vec3(x, y, z), turn), cell=cell)
    height = scene.top + 2.0
    for one in scene.objects:
        # A reset places them. Until then they are in the air and apart: MuJoCo wants room for contacts that it sees.
        height += one.radius + 2.0 * one.half_height
        body = builder.add_body(
            xform=wp.transform(wp.vec3(*one.at, height), wp.quat_identity()), label=one.name
        )
        _add_shape(builder, body, one, density=one.mass / one.volume, at=wp.transform_identity(), cell=cell)
    for one in scene.articulated:
        for shape in _add_articulated(builder, one, scene.top, cell):
            for other in still:  # it slides or turns free of what it stands on and among
                builder.add_shape_collision_filter_pair(shape, other)


def _add_shape(
    builder: newton.ModelBuilder, body: int, solid: Solid, *, density: float, at: wp.transform, cell: float
) -> list[int]:
    config = newton.ModelBuilder.ShapeConfig(
        density=density, mu=solid.friction, gap=0.0, has_particle_collision=False
    )
    more: dict[str, Any] = {"xform": at, "cfg": config, "color": solid.color, "label": solid.name}
    size = solid.size
    if solid.shape == "socket":
        return _add_boxes(builder, body, solid, solid.boards, at=at, density=density, color=solid.color)
    if solid.shape == "mesh":
        _draw(builder, solid.surface, cell, body=body, **more)
        return _add_mesh(builder, body, solid, at=at, density=density)
    if solid.shape == "box":
        hx, hy, hz = (0.5 * s for s in size)
        shape = builder.add_shape_box(body, hx=hx, hy=hy, hz=hz, **more)
    elif solid.shape == "sphere":
        shape = builder.add_shape_sphere(body, radius=size[0], **more)
    elif solid.shape == "cylinder":
        shape = builder.add_shape_cylinder(body, radius=size[0], half_height=0.5 * size[1], **more)
    else:
        shape = builder.add_shape_capsule(body, radius=size[0], half_height=0.5 * size[1], **more)
    return [shape]


def _add_mesh(
    builder: newton.ModelBuilder, body: int, solid: Solid, *, at: wp.transform, density: float
) -> list[int]:
    """What is touched of a mesh, and what it weighs: mass, centre and inertia are those of the surface's inside.

    MuJoCo takes the convex hull of each shape that is touched, so one without parts is both.
    """
    config = newton.ModelBuilder.ShapeConfig(
        density=density, mu=solid.friction, gap=0.0, has_particle_collision=False, is_visible=False
    )
    surface = solid.surface
    mesh = newton.Mesh(surface.vertices, surface.faces.flatten(), maxhullvert=MOST_CORNERS)
    more: dict[str, Any] = {"xform": at, "label": solid.name}
    if solid.parts is None:
        shapes = [builder.add_shape_mesh(body, mesh=mesh, cfg=config, **more)]
    else:
        config.has_shape_collision = False
        builder.add_shape_mesh(body, mesh=mesh, cfg=config, **more)
        config = replace(config, density=0.0, has_shape_collision=True)
        shapes = [
            builder.add_shape_convex_hull(body, mesh=_hull(corners), cfg=config, **more)
            for corners in solid.hulls
        ]
    return shapes


def _hull(corners: np.ndarray) -> newton.Mesh:
    faces = ConvexHull(corners).simplices.flatten()
    return newton.Mesh(corners, faces, maxhullvert=MOST_CORNERS, compute_inertia=False)


def _draw(builder: newton.ModelBuilder, surface: Surface, cell: float, **more: Any) -> None:
    """What is seen of a mesh: no detail smaller than ``cell`` [m], nor a tenth of its middle side."""
    piece = simplify(Piece(*surface.flat(), None), min(cell, 0.1 * sorted(surface.size)[1]))
    mesh = newton.Mesh(piece.vertices, piece.faces.flatten(), normals=piece.normals, compute_inertia=False)
    builder.add_shape_mesh(mesh=mesh, **(more | {"cfg": _unfelt()}))


def _unfelt() -> newton.ModelBuilder.ShapeConfig:
    return newton.ModelBuilder.ShapeConfig(
        density=0.0, has_shape_collision=False, has_particle_collision=False
    )


def _add_boxes(
    builder: newton.ModelBuilder,
    body: int,
    solid: Solid,
    boxes: list[Box],
    *,
    density: float,
    color: tuple[float, float, float],
    at: wp.transform | None = None,
) -> list[int]:
    """Boxes of one body, ``at`` its frame."""
    config = newton.ModelBuilder.ShapeConfig(
        density=density, mu=solid.friction, gap=0.0, has_particle_collision=False
    )
    shapes = []
    for center, size in boxes:
        frame = wp.transform(wp.vec3(*center), wp.quat_identity())
        hx, hy, hz = (0.5 * s for s in size)
        more: dict[str, Any] = {"cfg": config, "color": color, "label": solid.name}
        frame = frame if at is None else at * frame
        shapes.append(builder.add_shape_box(body, xform=frame, hx=hx, hy=hy, hz=hz, **more))
    return shapes


def _add_parts(
    builder: newton.ModelBuilder,
    body: int,
    one: ArticulatedFile,
    parts: Sequence[Part],
    *,
    origin: Point,
    color: Point,
    cell: float,
) -> list[int]:
    """Geometry of a file on one body, whose frame is at ``origin`` of the case's. Returns what is touched."""
    shapes = []
    for part in parts:
        turn = wp.quat_from_matrix(wp.mat33(*part.rotation.flatten().tolist()))
        at = wp.transform(wp.vec3(*(p - o for p, o in zip(part.place, origin, strict=True))), turn)
        more: dict[str, Any] = {"xform": at, "color": part.color or color, "label": one.name}
        if part.surface is not None and part.seen:
            _draw(builder, part.surface, cell, body=body, **more)
        config = newton.ModelBuilder.ShapeConfig(
            density=0.0, mu=one.friction, gap=0.0, has_particle_collision=False,
            is_visible=part.seen and part.surface is None,
        )  # fmt: skip
        more["cfg"] = config if part.touched else _unfelt()
        if part.hull is not None:
            hull = newton.Mesh(part.hull.vertices, part.hull.faces.flatten(), maxhullvert=MOST_CORNERS)
            shape = builder.add_shape_mesh(body, mesh=hull, **more)
        elif part.surface is not None:
            continue
        elif part.shape == "box":
            hx, hy, hz = part.size
            shape = builder.add_shape_box(body, hx=hx, hy=hy, hz=hz, **more)
        elif part.shape == "sphere":
            shape = builder.add_shape_sphere(body, radius=part.size[0], **more)
        elif part.shape == "cylinder":
            shape = builder.add_shape_cylinder(body, radius=part.size[0], half_height=part.size[1], **more)
        else:
            shape = builder.add_shape_capsule(body, radius=part.size[0], half_height=part.size[1], **more)
        if part.touched:
            shapes.append(shape)
    return shapes


def _add_articulated(
    builder: newton.ModelBuilder, one: Articulated | ArticulatedFile, top: float, cell: float
) -> list[int]:
    """A case that is fixed to the world, where each episode says, and what moves in it. Returns what is touched."""

    def shift(point: tuple[float, ...]) -> wp.transform:
        return wp.transform(wp.vec3(*point), wp.quat_identity())

    base = wp.transform(wp.vec3(*one.at, top), wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), one.angle))
    case = builder.add_link(xform=base, label=f"{one.name}_case")
    moving = builder.add_link(xform=base * shift(one.grip), label=one.name)
    if isinstance(one, ArticulatedFile):
        m = one.mechanism
        nowhere = (0.0, 0.0, 0.0)
        shapes = _add_parts(builder, case, one, m.case, origin=nowhere, color=one.case_color, cell=cell)
        shapes += _add_parts(builder, moving, one, m.moving, origin=one.grip, color=one.color, cell=cell)
        _weigh(builder, moving, m, one.grip)
        friction, damping, armature = m.friction, m.damping, m.armature
    else:
        shapes = _add_boxes(builder, case, one, one.case, density=0.0, color=one.case_color)
        density = one.mass / one.moving_volume
        shapes += _add_boxes(builder, moving, one, one.moving, density=density, color=one.color)
        friction, damping, armature = one.joint_friction, one.joint_damping, 0.0
    fixed = builder.add_joint_fixed(-1, case, parent_xform=base, label=f"{one.name}_base")
    add = builder.add_joint_prismatic if one.slides else builder.add_joint_revolute
    from_grip = tuple(h - g for h, g in zip(one.hinge, one.grip, strict=True))
    joint = add(
        case,
        moving,
        parent_xform=shift(one.hinge),
        child_xform=shift(from_grip),
        axis=wp.vec3(*one.axis),
        limit_lower=0.0,
        limit_upper=one.travel,
        friction=friction,
        damping=damping,
        armature=armature,
        label=f"{one.name}_joint",
    )
    builder.add_articulation([fixed, joint], label=one.name)
    dof = builder.joint_qd_start[joint]
    _set(builder, dof, {"mujoco:solreflimit": wp.vec2(*SOLREF), "mujoco:solreflimit_mode": 1})
    return shapes


def _weigh(builder: newton.ModelBuilder, body: int, m: Mechanism, origin: Point) -> None:
    """Mass, centre of mass and inertia of what moves, whose frame is at ``origin`` of the case's."""
    builder.body_mass[body], builder.body_inv_mass[body] = m.mass, 1.0 / m.mass
    builder.body_com[body] = wp.vec3(*(c - o for c, o in zip(m.center, origin, strict=True)))
    builder.body_inertia[body] = wp.mat33(*m.inertia.flatten().tolist())
    builder.body_inv_inertia[body] = wp.mat33(*np.linalg.inv(m.inertia).flatten().tolist())


def harden(builder: newton.ModelBuilder, step: float) -> None:
    """MuJoCo's contact parameters of all that is touched, as they are: Newton would make others of its own.

    Args:
        builder: It has everything that is touched.
        step: Length of a physics step [s]: the shorter, the stiffer.
    """
    values = {
        "mujoco:condim": 3,
        "mujoco:geom_solimp": wp.types.vector(length=5, dtype=wp.float32)(*SOLIMP),
        "mujoco:solref": wp.vec2(min(SOLREF[0], STEPS * step), SOLREF[1]),
        "mujoco:solref_mode": 1,
    }
    for shape, flags in enumerate(builder.shape_flags):
        if flags & newton.ShapeFlags.COLLIDE_SHAPES:
            _set(builder, shape, values)


def _set(builder: newton.ModelBuilder, index: int, values: dict[str, object]) -> None:
    """MuJoCo's own parameters of one shape or degree of freedom."""
    for name, value in values.items():
        attribute = builder.custom_attributes[name]
        if attribute.values is None:
            attribute.values = {}
        attribute.values[index] = value
