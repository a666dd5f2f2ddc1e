# pyright: reportArgumentType=false, reportCallIssue=false
# (Warp's annotations know neither vectors nor shapes as tuples.)
"""What of a Franka arm's links can be touched: capsules and boxes as the embedded robot is drawn."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import newton
import numpy as np
import warp as wp

from franka_wm.envs.config import FrankaConfig
from franka_wm.envs.constants import NUM_JOINTS
from franka_wm.envs.robots import Robot, add_robot, arm_builder, gripper
from franka_wm.errors import UserError

FRICTION = 0.4
"""Friction of all links."""
NEIGHBOURS = 2
"""Links that are so many joints apart, or fewer, never touch: what is drawn of them overlaps where they bend."""


class Part(NamedTuple):
    """A capsule (radius, half of its straight length, 0) or a box (half sides) of a link; 0 is the base."""

    link: int
    frame: wp.transform
    box: bool
    scale: tuple[float, float, float]


@lru_cache(maxsize=1)
def _embedded() -> tuple[Robot, tuple[Part, ...]]:
    """The embedded robot and its parts, without hand and fingers. A cylinder is a capsule of the same length."""
    builder = arm_builder()
    robot = add_robot(builder, FrankaConfig(gripper=True))
    links = {-1: 0} | {builder.joint_child[j]: j + 1 for j in range(NUM_JOINTS)}
    parts = []
    for shape in range(builder.shape_count):
        kind, (x, y, z) = builder.shape_type[shape], (float(s) for s in builder.shape_scale[shape])
        link = links.get(builder.shape_body[shape])
        box = kind == newton.GeoType.BOX
        if link is None or (link == NUM_JOINTS and box):
            continue
        scale = (x, max(y - x, 0.1 * y), 0.0) if kind == newton.GeoType.CYLINDER else (x, y, z)
        parts.append(Part(link, wp.transform(*builder.shape_transform[shape]), box, scale))
    return robot, tuple(parts)


def embedded_parts() -> tuple[Part, ...]:
    """What is touched of a Franka arm's links with ``collisions=arm``."""
    return _embedded()[1]


def is_franka(robot: Robot) -> bool:
    """Whether joints and tool are where those of a Franka arm with its hand are."""
    known = _embedded()[0]
    return np.allclose(known.parent_frames, robot.parent_frames, atol=1e-3) and np.allclose(
        known.tool_frame, robot.tool_frame, atol=1e-3
    )


def add_link_colliders(builder: newton.ModelBuilder, robot: Robot, *, itself: bool) -> None:
    """Capsules and boxes around all links, unseen, where hand and fingers have theirs already.

    Args:
        builder: It holds one world's arm with its gripper, and the scene.
        robot: That arm.
        itself: Whether links touch one another, and hand and fingers.

    Raises:
        UserError: The robot's joints are not where a Franka arm's are.
    """
    known, parts = _embedded()
    if not np.allclose(known.parent_frames, robot.parent_frames, atol=1e-3):
        raise UserError(
            "collisions: the links of a Franka arm are known, and this robot has its joints elsewhere; set it to hand"
        )
    config = newton.ModelBuilder.ShapeConfig(
        density=0.0, mu=FRICTION, gap=0.0, is_visible=False, has_particle_collision=False
    )
    bodies = [-1, *(builder.joint_child[j] for j in range(NUM_JOINTS))]
    links = {shape: NUM_JOINTS for shape, label in enumerate(builder.shape_label) if label in gripper.LABELS}
    for k, part in enumerate(parts):
        body, label = bodies[part.link], f"link{part.link}_{k}"
        a, b, c = part.scale
        if part.box:
            shape = builder.add_shape_box(body, xform=part.frame, hx=a, hy=b, hz=c, cfg=config, label=label)
        else:
            shape = builder.add_shape_capsule(
                body, xform=part.frame, radius=a, half_height=b, cfg=config, label=label
            )
        for other, link in links.items():
            if not itself or abs(part.link - link) <= NEIGHBOURS:
                builder.add_shape_collision_filter_pair(shape, other)
        links[shape] = part.link
