# pyright: reportArgumentType=false, reportCallIssue=false
# (Warp's annotations know neither vectors nor shapes as tuples.)
"""The hand that closes: two fingers driven by one command, and what of the hand can be touched."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import newton
import warp as wp

from franka_wm.envs.config import FrankaConfig
from franka_wm.envs.constants import MOST_OPEN, NUM_FINGERS, NUM_JOINTS
from franka_wm.errors import UserError

STIFFNESS = 50.0
"""Stiffness of a finger's servo, per newton of its largest force [1/m]: a 4 cm cube is squeezed with all of it."""
DAMPING = 40.0
"""Damping of a finger's servo at 20 N [N·s/m]; it goes with the root of the force."""
ARMATURE = 0.5
"""Armature of a finger [kg]: what drives it is geared down. With less, heavy objects are lost."""
FRICTION = 1.0
"""Friction of pads and palm."""

PAD, PAD_AWAY, PAD_ALONG = (0.010, 0.009, 0.0275), 0.010, 0.027
"""Half sides of a finger's box [m]; its centre in the finger's frame: away from the other one, and along it."""
PALM, PALM_BELOW = (0.031, 0.1025, 0.035), 0.0284
"""Half sides of the palm's box [m]; how far its centre lies before the fingers' joints."""

PADS = tuple(f"hand/pad{k}" for k in range(NUM_FINGERS))
LABELS = (*PADS, "hand/palm")
"""Labels of the boxes that are touched; nothing in a scene can have such a name."""


def free_fingers(root: ET.Element) -> None:
    """Prismatic joints of a URDF stay joints; what ties one to the other is the command, not the file."""
    for joint in root.iter("joint"):
        for mimic in joint.findall("mimic") if joint.get("type") == "prismatic" else ():
            joint.remove(mimic)


def check(builder: newton.ModelBuilder, path: Path) -> int:
    """How many fingers there are.

    Raises:
        UserError: Other than two, or they are not the last joints.
    """
    movable = [j for j in range(builder.joint_count) if builder.joint_type[j] != newton.JointType.FIXED]
    sliding = [j for j in movable if builder.joint_type[j] == newton.JointType.PRISMATIC]
    if len(sliding) != NUM_FINGERS or movable[-NUM_FINGERS:] != sliding:
        raise UserError(
            f"{path.name}: gripper=true needs {NUM_FINGERS} sliding finger joints behind the arm's, has {len(sliding)}"
        )
    return NUM_FINGERS


def drive(builder: newton.ModelBuilder, config: FrankaConfig) -> None:
    """Servos of the fingers; at the start they are open."""
    some, force = slice(NUM_JOINTS, NUM_JOINTS + NUM_FINGERS), config.gripper_force
    builder.joint_target_ke[some] = [STIFFNESS * force] * NUM_FINGERS
    builder.joint_target_kd[some] = [DAMPING * (force / 20.0) ** 0.5] * NUM_FINGERS
    builder.joint_armature[some] = [ARMATURE] * NUM_FINGERS
    builder.joint_effort_limit[some] = [force] * NUM_FINGERS
    builder.joint_q[some] = builder.joint_target_q[some] = [MOST_OPEN] * NUM_FINGERS


def speed_limit(builder: newton.ModelBuilder) -> float:
    """Speed limit of a finger [m/s]."""
    return float(builder.joint_velocity_limit[NUM_JOINTS])


def add_colliders(builder: newton.ModelBuilder, tool_body: int) -> None:
    """Boxes around both fingers and the palm, unseen; nothing else of the arm is touched."""
    config = newton.ModelBuilder.ShapeConfig(
        density=0.0, mu=FRICTION, gap=0.0, is_visible=False, has_particle_collision=False
    )
    for shape in range(builder.shape_count):  # what is drawn is not touched
        builder.shape_flags[shape] &= ~int(newton.ShapeFlags.COLLIDE_SHAPES)
    shapes = []
    for joint in range(NUM_JOINTS, NUM_JOINTS + NUM_FINGERS):
        away = wp.vec3(*builder.joint_axis[joint]) * PAD_AWAY  # a finger moves away from the other one
        at = wp.transform(away + wp.vec3(0.0, 0.0, PAD_ALONG), wp.quat_identity())
        hx, hy, hz = PAD
        body = builder.joint_child[joint]
        shapes.append(
            builder.add_shape_box(
                body, xform=at, hx=hx, hy=hy, hz=hz, cfg=config, label=PADS[joint - NUM_JOINTS]
            )
        )
    below = wp.transform(wp.vec3(0.0, 0.0, -PALM_BELOW), wp.quat_identity())
    at = wp.transform(*builder.joint_X_p[NUM_JOINTS]) * below
    hx, hy, hz = PALM
    shapes.append(
        builder.add_shape_box(tool_body, xform=at, hx=hx, hy=hy, hz=hz, cfg=config, label=LABELS[-1])
    )
    for k, one in enumerate(shapes):
        for other in shapes[k + 1 :]:
            builder.add_shape_collision_filter_pair(one, other)
