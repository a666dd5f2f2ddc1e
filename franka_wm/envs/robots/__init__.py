# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
# pyright: reportCallIssue=false, reportReturnType=false, reportIndexIssue=false
# (Warp's and TorchRL's annotations know neither vectors nor shapes as tuples.)
"""Robot descriptions, and the one function that puts any of them into a Newton model.

:mod:`~franka_wm.envs.robots.sources` says which URDF a name means and is where robots are added;
:mod:`~franka_wm.envs.robots.meshes` draws them.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

import newton
import numpy as np
import warp as wp

from franka_wm.envs.config import FrankaConfig
from franka_wm.envs.constants import NUM_FINGERS, NUM_JOINTS
from franka_wm.envs.robots import gripper, meshes
from franka_wm.envs.robots.description import read_description
from franka_wm.envs.robots.sources import SOURCES, Source, detail, urdf_source
from franka_wm.errors import UserError
from franka_wm.quiet import start_warp

__all__ = [
    "SOURCES",
    "TOOL_LINKS",
    "Robot",
    "Source",
    "add_robot",
    "arm_builder",
    "load_robot",
    "urdf_source",
]

TOOL_LINKS = ("fr3_hand_tcp", "panda_hand_tcp", "hand_tcp", "tool0", "tcp", "fr3_hand", "panda_hand")
"""Links that may be the tool, in order of preference."""


@dataclass(frozen=True)
class Robot:
    """Where the arm is in a builder that holds one world.

    Attributes:
        joint_names: The seven arm joints.
        lower, upper: Joint limits, (7,) [rad].
        velocity_limit: Joint speed limits, (7,) [rad/s].
        finger_speed: Speed limit of a finger [m/s]; 0 where fingers are held.
        parent_frames: Frame of each joint in its parent link, (7, 7) as x y z qx qy qz qw.
        child_frames: Frame of each joint in its own link, likewise.
        axes: Joint axes, (7, 3).
        tool_body: Body that carries the tool.
        tool_frame: Tool in that body, (7,) as above.
    """

    joint_names: tuple[str, ...]
    lower: np.ndarray
    upper: np.ndarray
    velocity_limit: np.ndarray
    finger_speed: float
    parent_frames: np.ndarray
    child_frames: np.ndarray
    axes: np.ndarray
    tool_body: int
    tool_frame: np.ndarray


def arm_builder() -> newton.ModelBuilder:
    """An empty builder for one world, with the MuJoCo attributes registered."""
    start_warp()
    builder = newton.ModelBuilder()
    newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
    return builder


def add_robot(
    builder: newton.ModelBuilder,
    config: FrankaConfig,
    urdf_path: str | Path | None = None,
    *,
    visuals: bool = True,
) -> Robot:
    """Adds the arm to ``builder``: seven driven joints, fingers held or driven, fixed links merged.

    Gains, armature, effort and angle limits are set; with ``gravity_compensation`` the solver cancels the
    weight of every link.

    Args:
        builder: What :func:`arm_builder` gives.
        config: Gains, armature, finger opening, choice of robot.
        urdf_path: Overrides the robot that the config names.
        visuals: Whether it is drawn.

    Raises:
        UserError: If the file is not a URDF of an arm with seven movable joints and a known tool link, or a
            mesh that it names cannot be read.
    """
    path = urdf_source(config, urdf_path)
    root = read_description(path)
    if config.has_gripper:
        gripper.free_fingers(root)
    else:
        _hold_fingers(root, config.finger_opening)
    drawn = _prepare_shapes(root, path, visuals)
    try:
        builder.add_urdf(
            ET.tostring(root, encoding="unicode"),
            floating=False,
            enable_self_collisions=False,
            parse_visuals_as_colliders=False,
        )
    except Exception as error:  # Newton's reader fails in ways of its own
        raise UserError(f"{path.name}: Newton cannot read it ({type(error).__name__}: {error})") from error
    for body, label in enumerate(builder.body_label):
        meshes.draw(
            builder, body, drawn.get(label.rsplit("/", 1)[-1], []), detail(SOURCES[config.robot], config)
        )
    movable = [j for j in range(builder.joint_count) if builder.joint_type[j] != newton.JointType.FIXED]
    if config.has_gripper:
        movable = movable[: len(movable) - gripper.check(builder, path)]
    fingers = NUM_FINGERS * config.has_gripper
    if len(movable) != NUM_JOINTS or builder.joint_coord_count != NUM_JOINTS + fingers:
        names = ", ".join(builder.joint_label[j] for j in movable)
        raise UserError(
            f"{path.name}: needs exactly {NUM_JOINTS} arm joints besides the fingers, has {len(movable)} ({names})"
        )
    tool_link, tool_frame = _find_tool(builder, path)
    merged = _merged_inertia(builder)
    builder.collapse_fixed_joints()
    _set_inertia(builder, merged, path)
    carrier = builder.body_label.index(tool_link)

    joints = range(NUM_JOINTS)
    builder.joint_q[:NUM_JOINTS] = config.start_pose
    builder.joint_target_q[:NUM_JOINTS] = config.start_pose
    builder.joint_target_ke[:NUM_JOINTS] = config.gains("target_ke")
    builder.joint_target_kd[:NUM_JOINTS] = config.gains("target_kd")
    builder.joint_armature[:NUM_JOINTS] = [config.joint_armature] * NUM_JOINTS
    if config.has_gripper:
        gripper.drive(builder, config)
    if config.gravity_compensation:
        _compensate_gravity(builder)
    return Robot(
        joint_names=tuple(builder.joint_label[j].rsplit("/", 1)[-1] for j in joints),
        lower=np.array(builder.joint_limit_lower[:NUM_JOINTS], dtype=np.float32),
        upper=np.array(builder.joint_limit_upper[:NUM_JOINTS], dtype=np.float32),
        velocity_limit=np.array(builder.joint_velocity_limit[:NUM_JOINTS], dtype=np.float32),
        finger_speed=gripper.speed_limit(builder) if config.has_gripper else 0.0,
        parent_frames=np.array([list(builder.joint_X_p[j]) for j in joints], dtype=np.float32),
        child_frames=np.array([list(builder.joint_X_c[j]) for j in joints], dtype=np.float32),
        axes=np.array([list(builder.joint_axis[j]) for j in joints], dtype=np.float32),
        tool_body=carrier,
        tool_frame=np.array(list(tool_frame), dtype=np.float32),
    )


def load_robot(config: FrankaConfig, urdf_path: str | Path | None = None) -> Robot:
    """The robot's description alone, without a simulation."""
    builder = arm_builder()
    return add_robot(builder, config, urdf_path, visuals=False)


def _prepare_shapes(root: ET.Element, path: Path, visuals: bool) -> dict[str, list[meshes.Piece]]:
    """Leaves in the URDF what Newton reads itself, primitives, and returns the meshes to draw, by link.

    Nothing collides here, so colliders serve two ends alone: they are drawn where a robot has nothing else, and
    give a link its mass where it has no ``<inertial>``.
    """
    bare = root.find("link/visual") is None
    for link in root.iter("link"):
        weighed = link.find("inertial") is not None
        for collision in link.findall("collision"):
            if bare:
                copy = ET.SubElement(link, "visual")
                copy.extend(collision)
            if weighed:
                link.remove(collision)
        if not visuals:
            for visual in link.findall("visual"):
                link.remove(visual)
    drawn = meshes.take_visuals(root, path)
    for mesh in root.iter("mesh"):
        file = meshes.resolve(mesh.get("filename", ""), path)
        meshes.read(file)  # says what is missing or wrong
        mesh.set("filename", str(file))
    return drawn


def _hold_fingers(root: ET.Element, opening: float) -> None:
    """Fixes the prismatic joints at ``opening`` [m].

    Reaching needs no gripper: nine degrees of freedom would cost a third more physics than seven.
    """
    for joint in root.iter("joint"):
        if joint.get("type") != "prismatic":
            continue
        origin, axis = joint.find("origin"), joint.find("axis")
        if origin is None:
            origin = ET.SubElement(joint, "origin")
        xyz = np.array([float(v) for v in (origin.get("xyz") or "0 0 0").split()])
        rpy = [float(v) for v in (origin.get("rpy") or "0 0 0").split()]
        direction = np.array(
            [float(v) for v in ((axis.get("xyz") if axis is not None else None) or "1 0 0").split()]
        )
        rotation = np.array(wp.quat_to_matrix(wp.quat_rpy(*rpy))).reshape(3, 3)
        origin.set("xyz", " ".join(f"{v:.9g}" for v in xyz + rotation @ direction * opening))
        joint.set("type", "fixed")
        for tag in ("axis", "limit", "mimic", "dynamics"):
            for child in joint.findall(tag):
                joint.remove(child)


def _find_tool(builder: newton.ModelBuilder, path: Path) -> tuple[str, wp.transform]:
    """The moving link that carries the tool, and the tool's frame in it."""
    names = {label.rsplit("/", 1)[-1]: body for body, label in enumerate(builder.body_label)}
    found = next((name for name in TOOL_LINKS if name in names), None)
    if found is None:
        raise UserError(f"{path.name}: no tool link; name one of its links {', '.join(TOOL_LINKS)}")
    body, frame = names[found], wp.transform_identity()
    parents = {builder.joint_child[j]: j for j in range(builder.joint_count)}
    while builder.joint_type[parents[body]] == newton.JointType.FIXED:
        joint = parents[body]
        step = wp.transform(*builder.joint_X_p[joint]) * wp.transform_inverse(
            wp.transform(*builder.joint_X_c[joint])
        )
        frame = step * frame
        body = builder.joint_parent[joint]
        if body < 0:
            raise UserError(f"{path.name}: tool link {found!r} does not move with the arm")
    return builder.body_label[body], frame


def _merged_inertia(builder: newton.ModelBuilder) -> dict[str, tuple[float, np.ndarray, np.ndarray]]:
    """Mass, centre of mass and inertia about it, by label, of each moving link with all that is fixed to it.

    Newton 1.8 merges masses and centres of mass correctly, but moves inertias by the joint's offset instead of
    the distance between centres of mass: 10 % off for the last link with its hand.
    """
    parents = {builder.joint_child[j]: j for j in range(builder.joint_count)}
    parts: dict[int, list[tuple[float, np.ndarray, np.ndarray]]] = {}
    for body in range(builder.body_count):
        frame, carrier = wp.transform_identity(), body
        while carrier >= 0 and builder.joint_type[parents[carrier]] == newton.JointType.FIXED:
            joint = parents[carrier]
            inverse = wp.transform_inverse(wp.transform(*builder.joint_X_c[joint]))
            frame = wp.transform(*builder.joint_X_p[joint]) * inverse * frame
            carrier = builder.joint_parent[joint]
        if carrier < 0 or builder.body_mass[body] == 0.0:  # fixed to the world, or a mere frame
            continue
        rotation = np.array(wp.quat_to_matrix(wp.transform_get_rotation(frame)), dtype=np.float64).reshape(
            3, 3
        )
        centre = np.array(wp.transform_point(frame, wp.vec3(*builder.body_com[body])), dtype=np.float64)
        inertia = np.array(builder.body_inertia[body], dtype=np.float64).reshape(3, 3)
        part = (float(builder.body_mass[body]), centre, rotation @ inertia @ rotation.T)
        parts.setdefault(carrier, []).append(part)
    out = {}
    for carrier, pieces in parts.items():
        mass = sum(m for m, _, _ in pieces)
        centre = sum((m * c for m, c, _ in pieces), np.zeros(3)) / mass
        total = np.zeros((3, 3))
        for m, c, inertia in pieces:
            d = c - centre
            total += inertia + m * (d @ d * np.eye(3) - np.outer(d, d))  # Steiner
        out[builder.body_label[carrier]] = (mass, centre, total)
    return out


def _set_inertia(
    builder: newton.ModelBuilder, merged: dict[str, tuple[float, np.ndarray, np.ndarray]], path: Path
) -> None:
    for label in builder.body_label:
        mass, _, inertia = merged.get(label, (0.0, None, np.zeros((3, 3))))
        if mass <= 0 or not np.linalg.eigvalsh(inertia)[0] > 0:
            link = label.rsplit("/", 1)[-1]
            raise UserError(
                f"{path.name}: link {link!r} moves and has a mass of {mass:g} kg, or an inertia that no body has; "
                "give it an <inertial>"
            )
    for label, (mass, centre, inertia) in merged.items():
        body = builder.body_label.index(label)
        builder.body_mass[body], builder.body_inv_mass[body] = mass, 1.0 / mass
        builder.body_com[body] = wp.vec3(*centre.tolist())
        builder.body_inertia[body] = wp.mat33(*inertia.flatten().tolist())
        builder.body_inv_inertia[body] = wp.mat33(*np.linalg.inv(inertia).flatten().tolist())


def _compensate_gravity(builder: newton.ModelBuilder) -> None:
    for name, count in (
        ("mujoco:jnt_actgravcomp", builder.joint_dof_count),
        ("mujoco:gravcomp", builder.body_count),
    ):
        attribute = builder.custom_attributes[name]
        if attribute.values is None:
            attribute.values = {}
        for index in range(count):
            attribute.values[index] = True if name.endswith("actgravcomp") else 1.0
