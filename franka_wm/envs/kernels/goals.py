# pyright: reportIndexIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false, reportAssignmentType=false, reportReturnType=false
# (Kernels are Warp's language: pyright knows neither its arrays nor its vectors.)
"""Where arm, fingers and objects are in images of the goal."""

# Warp reads annotations as types: no `from __future__ import annotations` here.
import warp as wp

from franka_wm.envs.constants import NUM_FINGERS
from franka_wm.envs.kernels.functions import JOINTS

FINGERS = wp.constant(NUM_FINGERS)
ITERATIONS = wp.constant(32)
DAMPING, LONGEST = wp.constant(1.0e-4), wp.constant(0.3)
"""Added to J Jᵀ [m², rad²]; the longest step of a joint in one iteration [rad]."""


@wp.kernel(enable_backward=False)
def begin_goal(mask: wp.array[wp.bool], rest_q: wp.array2d[float], goal_rest: wp.array2d[float]):
    """Fingers and objects of the masked worlds as the episode begins: a task then moves what its goal moves."""
    world = wp.tid()
    if mask[world]:
        for i in range(rest_q.shape[1]):
            goal_rest[world, i] = rest_q[world, i]


@wp.kernel(enable_backward=False)
def join_goal(goal_q: wp.array2d[float], goal_rest: wp.array2d[float], joint_q: wp.array2d[float]):
    """All coordinates of a goal as Newton orders them."""
    world = wp.tid()
    for j in range(JOINTS):
        joint_q[world, j] = goal_q[world, j]
    for i in range(goal_rest.shape[1]):
        joint_q[world, JOINTS + i] = goal_rest[world, i]


@wp.func
def nearest_turn(angle: float, step: float) -> float:
    """The angle nearest to 0 that is ``angle`` up to turns by ``step`` [rad]."""
    return angle - step * wp.round(angle / step)


@wp.kernel(enable_backward=False)
def hold_open(
    mask: wp.array[wp.bool],
    bases: wp.array2d[wp.transformf],
    grip: wp.vec3f,
    around: float,
    joint: int,
    travel: float,
    opening: float,
    goal_rest: wp.array2d[float],
    hand: wp.array2d[float],
):
    """The first drawer all open, the hand at ``grip``, where its handle then is in the case's frame, turned by ``around``."""
    world = wp.tid()
    if not mask[world]:
        return
    place = wp.transform_point(bases[world, 0], grip)
    turn = wp.transform_get_rotation(bases[world, 0])
    for i in range(3):
        hand[world, i] = place[i]
    hand[world, 3] = nearest_turn(
        2.0 * wp.atan2(turn[2], turn[3]) + around, wp.PI
    )  # a bar is the same after half a turn
    for f in range(FINGERS):
        goal_rest[world, f] = opening
    goal_rest[world, joint] = travel


@wp.kernel(enable_backward=False)
def solve_upright(
    mask: wp.array[wp.bool],
    hand: wp.array2d[float],
    home: wp.array[float],
    lower: wp.array[float],
    upper: wp.array[float],
    parent_frames: wp.array[wp.transformf],
    child_frames: wp.array[wp.transformf],
    axes: wp.array[wp.vec3f],
    tool_frame: wp.array[wp.transformf],
    # scratch
    origins: wp.array2d[wp.vec3f],
    directions: wp.array2d[wp.vec3f],
    # output
    goal_q: wp.array2d[float],
):
    """Joints that put the hand at ``hand`` (x, y, z, yaw), pointing down; from the home pose, inside the limits.

    Damped least squares (Wampler 1986), as ``Kinematics.solve_upright`` has it in torch; the 6 × 6 system is solved
    by blocks of 3.
    """
    world = wp.tid()
    if not mask[world]:
        return
    for j in range(JOINTS):
        goal_q[world, j] = home[j]
    wish = wp.vec3f(hand[world, 0], hand[world, 1], hand[world, 2])
    wanted = wp.quatf(wp.cos(0.5 * hand[world, 3]), wp.sin(0.5 * hand[world, 3]), 0.0, 0.0)
    for _iteration in range(ITERATIONS):
        frame = wp.transform_identity(dtype=float)
        for j in range(JOINTS):
            frame = frame * parent_frames[j]
            origins[world, j] = wp.transform_get_translation(frame)
            directions[world, j] = wp.transform_vector(frame, axes[j])
            turn = wp.transformf(wp.vec3f(0.0, 0.0, 0.0), wp.quat_from_axis_angle(axes[j], goal_q[world, j]))
            frame = frame * turn * wp.transform_inverse(child_frames[j])
        frame = frame * tool_frame[0]
        tool = wp.transform_get_translation(frame)
        away = wanted * wp.quat_inverse(wp.transform_get_rotation(frame))
        missing = wish - tool
        twist = wp.vec3f(away[0], away[1], away[2]) * wp.where(away[3] < 0.0, -2.0, 2.0)
        linear = wp.identity(n=3, dtype=float) * DAMPING
        angular = wp.identity(n=3, dtype=float) * DAMPING
        mixed = wp.identity(n=3, dtype=float) * 0.0
        for j in range(JOINTS):
            column = wp.cross(directions[world, j], tool - origins[world, j])
            linear += wp.outer(column, column)
            angular += wp.outer(directions[world, j], directions[world, j])
            mixed += wp.outer(column, directions[world, j])
        back = wp.transpose(mixed) * wp.inverse(linear)
        spin = wp.inverse(angular - back * mixed) * (twist - back * missing)
        pull = wp.inverse(linear) * (missing - mixed * spin)
        for j in range(JOINTS):
            column = wp.cross(directions[world, j], tool - origins[world, j])
            step = wp.dot(column, pull) + wp.dot(directions[world, j], spin)
            value = goal_q[world, j] + wp.clamp(step, -LONGEST, LONGEST)
            goal_q[world, j] = wp.clamp(value, lower[j], upper[j])
