# pyright: reportArgumentType=false, reportCallIssue=false
# (Warp's annotations know neither vectors nor shapes as tuples.)
"""What is refused before a world is built: a goal or an object out of reach, a scene that the robot would start in."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import warp as wp

from franka_wm.envs.config import FrankaConfig
from franka_wm.envs.constants import MOST_OPEN
from franka_wm.envs.kinematics import Kinematics
from franka_wm.envs.robots import Robot, gripper, links, load_robot
from franka_wm.envs.scene import FLOOR, Scene, Solid
from franka_wm.envs.solids import Obstacle, Table
from franka_wm.envs.tasks import Task
from franka_wm.errors import UserError
from franka_wm.options import check_whole

FINGERS_ABOVE = 0.045
"""From the tool back to the joints of a Franka Hand's fingers [m]."""


class _Box(NamedTuple):
    """Centre (3,), rotation (3, 3) and half sides (3,) of a box [m]."""

    at: np.ndarray
    rotation: np.ndarray
    half: np.ndarray


def check_arguments(config: object, num_envs: object, seed: object, first_world: object) -> None:
    """Refuses what is no configuration, number of worlds or seed, and another default of PyTorch than float32."""
    if torch.get_default_dtype() != torch.float32:
        raise UserError(
            f"torch.set_default_dtype({torch.get_default_dtype()}): worlds are simulated in float32; "
            "call torch.set_default_dtype(torch.float32), and convert what the environment gives"
        )
    if not isinstance(config, FrankaConfig):
        raise UserError(
            f"config={config!r}: must be a FrankaConfig; of a dictionary, FrankaConfig.from_mapping"
        )
    check_whole("num_envs", num_envs)
    check_whole("seed", seed, least=0, most=2**64 - 1)
    check_whole("first_world", first_world, least=0, most=2**31 - 1)


def check_robot(config: FrankaConfig, urdf_path: str | Path | None = None) -> None:
    """Refuses a robot that cannot be loaded, a fixed goal out of its reach, and what :func:`check_start` refuses."""
    robot = load_robot(config, urdf_path)
    if config.fixed_goal:
        _check_goal(config, robot)
    check_start(config, robot)


def check_task(task: Task, config: FrankaConfig, urdf_path: str | Path | None = None) -> FrankaConfig:
    """The config, if a task that is given as an object can be played in it. Of one with a name the config knows."""
    type(task).check(config)
    if config.reward not in task.rewards:
        raise UserError(f"reward={config.reward!r}: {type(task).__name__} has {', '.join(task.rewards)}")
    robot = load_robot(config, urdf_path)
    if not task.draws_goals and config.goal_sampling != "reachable":
        _check_goal(config, robot)
    check_start(config, robot)
    return config


def _check_goal(config: FrankaConfig, robot: Robot) -> None:
    if not Kinematics(robot).reachable(config.goal):
        raise UserError(
            f"goal={config.goal} m: out of the arm's reach; it reaches about 0.85 m from (0, 0, 0.333)"
        )
    scene = config.resolved_scene
    for one in (scene.table, *scene.obstacles) if scene else ():
        place, half = _standing(one)
        inside = wp.transform_point(wp.transform_inverse(place), wp.vec3(*config.goal))
        if one.shape != "mesh" and all(abs(float(x)) < h for x, h in zip(inside, half, strict=True)):
            where = "under it" if isinstance(one, Table) else "in it"
            raise UserError(f"goal={config.goal} m: lies {where}: scene.{one.name}; move one of them")


def check_start(config: FrankaConfig, robot: Robot) -> None:
    """Refuses a start beyond the joints' limits, a scene that hand or arm would start in, and objects out of reach.

    Objects may be as large, and the table as high, as randomization makes them. Of round things counts the box inside
    them, and meshes are not looked at, since the box around one may be mostly empty. Nor are arms and hands that are
    not Franka's.

    Raises:
        UserError: One line, with the name of what is in the way.
    """
    for joint, (q, low, high) in enumerate(zip(config.start_pose, robot.lower, robot.upper, strict=True)):
        if not low <= q <= high:
            raise UserError(f"home: joint {joint + 1} at {q:g} rad; its limits are {low:.3f} and {high:.3f}")
    scene = config.resolved_scene
    if scene is None:
        return
    if scene.top:
        _check_reach(scene, Kinematics(robot))
    if not links.is_franka(robot):
        return
    frames = _link_frames(config, robot)
    hand = list(_hand(frames[-1] * wp.transform(*robot.tool_frame)))
    arm = list(_arm(frames)) if config.collisions != "hand" else []
    grown, raised = (
        1.0 + config.randomization.object_size,
        np.array([0.0, 0.0, config.randomization.table_height]),
    )
    for one in (scene.table, *scene.obstacles):
        if one.shape == "mesh":
            continue
        place, half = _standing(one)
        box = _box(place, half + raised)
        touched = {"hand": hand} if one is scene.table else {"hand": hand, "arm": arm}
        for what, boxes in touched.items():
            if any(_overlap(box, other) for other in boxes):
                raise UserError(
                    f"scene.{one.name}: stands in the {what} where it starts; move it (at), or start elsewhere (home)"
                )
    for one in scene.objects:
        if one.shape == "mesh":
            continue
        half = np.array([*one.spread, 0.0]) + grown * _filled(one) + raised
        place = wp.vec3(*one.at, scene.top + grown * one.half_height)
        if any(_overlap(_box(wp.transform(place, wp.quat_identity()), half), other) for other in hand):
            drawn = [
                f"randomization.{name}"
                for name in ("object_size", "table_height")
                if getattr(config.randomization, name)
            ]
            lower = f"make it lower ({', '.join(['size', *drawn])})"
            raise UserError(
                f"scene.{one.name}: {2 * one.half_height:g} m high, it may start in the hand; {lower}, or move it "
                "(at, spread)"
            )


def _standing(one: Obstacle) -> tuple[wp.transform, np.ndarray]:
    """Place and half sides (3,) of the box that a table or an obstacle fills [m]; a table's reaches to the floor."""
    half, height = _filled(one), one.at[2]
    if isinstance(one, Table):  # its place is that of its top
        half[2] = 0.5 * max(2.0 * half[2], height - FLOOR)
        height -= half[2]
    turn = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), one.angle)
    return wp.transform(wp.vec3(*one.at[:2], height), turn), half


def _filled(one: Solid) -> np.ndarray:
    """Half sides (3,) of a box that a solid fills [m]: of a round one the largest inside it."""
    radius, high = 0.5 * one.widths[0], one.half_height
    if one.shape == "sphere":
        return np.full(3, radius / math.sqrt(3))
    if one.shape in ("cylinder", "capsule"):
        side = radius / math.sqrt(2)
        return np.array([side, side, high - radius * (one.shape == "capsule")])
    return np.array([0.5 * one.widths[0], 0.5 * one.widths[1], high])


def _check_reach(scene: Scene, kinematics: Kinematics) -> None:
    for one in scene.objects:
        for i, j in itertools.product((-1, 1), repeat=2):
            place = (
                one.at[0] + i * one.spread[0],
                one.at[1] + j * one.spread[1],
                scene.top + one.half_height,
            )
            if not kinematics.reachable(place):
                raise UserError(
                    f"scene.table.at: with its top at {scene.top:g} m, {one.name} may start at "
                    f"({', '.join(f'{x:.2f}' for x in place)}) m, out of the arm's reach; change it, or at and spread"
                )


def _link_frames(config: FrankaConfig, robot: Robot) -> list:
    """Frames (``wp.transform``) of base and links where an episode starts, without its noise."""
    frames = [wp.transform_identity()]
    for q, parent, child, axis in zip(
        config.start_pose, robot.parent_frames, robot.child_frames, robot.axes, strict=True
    ):
        turn = wp.transform(wp.vec3(0.0, 0.0, 0.0), wp.quat_from_axis_angle(wp.vec3(*axis), q))
        frames.append(frames[-1] * wp.transform(*parent) * turn * wp.transform_inverse(wp.transform(*child)))
    return frames


def _hand(tool: wp.transform) -> Iterator[_Box]:
    """Palm and open fingers as they are touched, in the frame of a tool that points along z."""
    wide = MOST_OPEN + gripper.PAD_AWAY
    for at, half in (
        ((0.0, 0.0, -FINGERS_ABOVE - gripper.PALM_BELOW), gripper.PALM),
        ((0.0, wide, gripper.PAD_ALONG - FINGERS_ABOVE), gripper.PAD),
        ((0.0, -wide, gripper.PAD_ALONG - FINGERS_ABOVE), gripper.PAD),
    ):
        yield _box(tool * wp.transform(wp.vec3(*at), wp.quat_identity()), half)


def _arm(frames: list) -> Iterator[_Box]:
    """Boxes in what is touched of the links. The base stands still."""
    for part in links.embedded_parts():
        a, b, c = part.scale
        if part.link:
            yield _box(
                frames[part.link] * part.frame,
                (a, b, c) if part.box else (a / math.sqrt(2), a / math.sqrt(2), b),
            )


def _box(frame: wp.transform, half) -> _Box:
    rotation = np.array(wp.quat_to_matrix(wp.transform_get_rotation(frame)), dtype=float).reshape(3, 3)
    return _Box(
        np.array(wp.transform_get_translation(frame), dtype=float), rotation, np.asarray(half, dtype=float)
    )


def _overlap(one: _Box, other: _Box) -> bool:
    """Whether no plane parts them: their faces and the products of their edges are all that may
    (Gottschalk et al., "OBBTree", 1996)."""
    edges = [np.cross(a, b) for a, b in itertools.product(one.rotation.T, other.rotation.T)]
    for axis in (*one.rotation.T, *other.rotation.T, *edges):
        if (length := math.sqrt(axis @ axis)) < 1e-6:
            continue  # parallel edges
        reach = sum(np.abs(axis @ box.rotation) @ box.half for box in (one, other))
        if abs(axis @ (other.at - one.at)) >= reach - 1e-6 * length:
            return False
    return True
