# pyright: reportIndexIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false, reportAssignmentType=false, reportReturnType=false
# (Kernels are Warp's language: pyright knows neither its arrays nor its vectors.)
"""Drawers and doors: where their cases stand, and what is observed of them."""

# Warp reads annotations as types: no `from __future__ import annotations` here.
import warp as wp

from franka_wm.envs.constants import JOINT_DIM, NUM_FINGERS, OBJECT_DIM
from franka_wm.envs.kernels.functions import away_from, away_from_box, episode_rng

FINGERS = wp.constant(NUM_FINGERS)
EACH = wp.constant(OBJECT_DIM)
JOINT = wp.constant(JOINT_DIM)
ATTEMPTS = wp.constant(64)


@wp.kernel(enable_backward=False)
def place_cases(
    mask: wp.array[wp.bool],
    seed: wp.array[int],
    episode: wp.array[int],
    middle: wp.array2d[float],
    spread: wp.array2d[float],
    footprints: wp.array2d[float],
    blocked: wp.array2d[float],
    height: float,
    raised: wp.array[float],
    margin: float,
    count: int,
    # outputs
    bases: wp.array2d[wp.transformf],
    rest_q: wp.array2d[float],
):
    """New episodes of the masked worlds: cases where nothing else stands, closed. Objects are placed after them.

    Rows of ``middle`` and ``spread`` are x, y [m] and an angle [rad]; of ``footprints`` middle x, y and half sides [m].
    """
    world = wp.tid()
    if not mask[world]:
        return
    rng = episode_rng(seed[0], seed[1] + world, episode[world], 9)
    for m in range(middle.shape[0]):
        rest_q[world, FINGERS + 7 * count + m] = 0.0
        found = bool(False)
        base = wp.transform_identity(dtype=float)
        around = wp.length(wp.vec2f(footprints[m, 2], footprints[m, 3])) + margin
        for _attempt in range(ATTEMPTS):
            if not found:
                x = middle[m, 0] + spread[m, 0] * wp.randf(rng, -1.0, 1.0)
                y = middle[m, 1] + spread[m, 1] * wp.randf(rng, -1.0, 1.0)
                angle = middle[m, 2] + spread[m, 2] * wp.randf(rng, -1.0, 1.0)
                turn = wp.quatf(0.0, 0.0, wp.sin(0.5 * angle), wp.cos(0.5 * angle))
                base = wp.transformf(wp.vec3f(x, y, height + raised[world]), turn)
                at = wp.transform_point(base, wp.vec3f(footprints[m, 0], footprints[m, 1], 0.0))
                clear = bool(True)
                for o in range(blocked.shape[0]):  # x, y, half sides, cosine and sine of the angle, radius
                    there = wp.vec2f(blocked[o, 0], blocked[o, 1])
                    away = away_from_box(
                        at[0], at[1], there, blocked[o, 2], blocked[o, 3], blocked[o, 4], blocked[o, 5]
                    )
                    if away < around + blocked[o, 6]:
                        clear = False
                for o in range(m):
                    if away_from(at[0], at[1], bases[world, o], footprints, o) < around:
                        clear = False
                found = clear
        bases[world, m] = base


@wp.kernel(enable_backward=False)
def observe(
    rest_q: wp.array2d[float],
    rest_qd: wp.array2d[float],
    bases: wp.array2d[wp.transformf],
    grips: wp.array[wp.vec3f],
    hinges: wp.array[wp.vec3f],
    axes: wp.array[wp.vec3f],
    slides: wp.array[int],
    count: int,
    # output
    objects: wp.array2d[float],
):
    """Behind ``count`` objects 13 numbers of each handle, and behind these 2 of each joint."""
    world = wp.tid()
    total = grips.shape[0]
    for m in range(total):
        opened = rest_q[world, FINGERS + 7 * count + m]
        speed = rest_qd[world, FINGERS + 6 * count + m]
        base = bases[world, m]
        axis = wp.transform_vector(base, axes[m])
        place = wp.transform_point(base, grips[m])
        rotation = wp.transform_get_rotation(base)
        linear = axis * speed
        angular = wp.vec3f(0.0, 0.0, 0.0)
        if slides[m] != 0:
            place += axis * opened
        else:
            hinge = wp.transform_point(base, hinges[m])
            turn = wp.quat_from_axis_angle(axis, opened)
            arm = wp.quat_rotate(turn, place - hinge)
            place = hinge + arm
            rotation = turn * rotation
            angular = axis * speed
            linear = wp.cross(angular, arm)
        out = EACH * (count + m)
        sign = wp.where(rotation[3] < 0.0, -1.0, 1.0)
        for i in range(3):
            objects[world, out + i] = place[i]
            objects[world, out + 7 + i] = linear[i]
            objects[world, out + 10 + i] = angular[i]
        for i in range(4):
            objects[world, out + 3 + i] = sign * rotation[i]
        objects[world, EACH * (count + total) + JOINT * m] = opened
        objects[world, EACH * (count + total) + JOINT * m + 1] = speed
