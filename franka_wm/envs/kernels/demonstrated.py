# pyright: reportIndexIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false, reportAssignmentType=false, reportReturnType=false
# (Kernels are Warp's language: pyright knows neither its arrays nor its vectors.)
"""Episodes that begin along a demonstration."""

# Warp reads annotations as types: no `from __future__ import annotations` here.
import warp as wp

from franka_wm.envs.constants import JOINT_DIM, NUM_FINGERS, NUM_JOINTS, OBJECT_DIM, STATE_DIM
from franka_wm.envs.kernels.functions import episode_rng

ARM = wp.constant(NUM_JOINTS)
FINGERS = wp.constant(NUM_FINGERS)
HAND = wp.constant(STATE_DIM)
EACH = wp.constant(OBJECT_DIM)
JOINT = wp.constant(JOINT_DIM)


@wp.kernel(enable_backward=False)
def begin_along(
    mask: wp.array[wp.bool],
    seed: wp.array[int],
    episode: wp.array[int],
    share: float,
    earliest: wp.array[float],
    first: wp.array[int],
    steps: wp.array[int],
    state: wp.array2d[float],
    joint_target: wp.array2d[float],
    objects: wp.array2d[float],
    goal: wp.array2d[float],
    count: int,
    grips: wp.array[wp.vec3f],
    hinges: wp.array[wp.vec3f],
    axes: wp.array[wp.vec3f],
    slides: wp.array[int],
    # outputs
    joint_q: wp.array2d[float],
    joint_qd: wp.array2d[float],
    target: wp.array2d[float],
    control: wp.array2d[float],
    rest_q: wp.array2d[float],
    rest_qd: wp.array2d[float],
    rest_control: wp.array2d[float],
    grip: wp.array[float],
    bases: wp.array2d[wp.transformf],
    task_goal: wp.array2d[float],
):
    """Puts a ``share`` of the masked worlds where a recorded step began, with the goal that it had.

    The episode is drawn uniformly, and then the step, from the part ``earliest`` in [0, 1) of the episode on. Rows of
    ``state``, ``joint_target``, ``objects`` and ``goal`` are the steps of all episodes; episode e has ``steps[e]`` from row
    ``first[e]`` on. What is observed of a drawer's or a door's handle says where its case stands.
    """
    world = wp.tid()
    if not mask[world]:
        return
    rng = episode_rng(seed[0], seed[1] + world, episode[world], 14)
    if wp.randf(rng) >= share:
        return
    e = wp.min(int(wp.randf(rng) * float(first.shape[0])), first.shape[0] - 1)
    way = earliest[0] + (1.0 - earliest[0]) * wp.randf(rng)
    row = first[e] + wp.min(int(way * float(steps[e])), steps[e] - 1)
    for j in range(ARM):
        joint_q[world, j] = state[row, j]
        joint_qd[world, j] = state[row, ARM + j]
        target[world, j] = joint_target[row, j]
        control[world, j] = joint_target[row, j]
    grip[world] = joint_target[row, ARM]
    for f in range(FINGERS):
        rest_q[world, f] = state[row, HAND + f]
        rest_qd[world, f] = state[row, HAND + FINGERS + f]
        rest_control[world, f] = joint_target[row, ARM]
    for b in range(count):
        for i in range(7):
            rest_q[world, FINGERS + 7 * b + i] = objects[row, EACH * b + i]
        for i in range(6):
            rest_qd[world, FINGERS + 6 * b + i] = objects[row, EACH * b + 7 + i]
    total = grips.shape[0]
    for m in range(total):
        opened = objects[row, EACH * (count + total) + JOINT * m]
        rest_q[world, FINGERS + 7 * count + m] = opened
        rest_qd[world, FINGERS + 6 * count + m] = objects[row, EACH * (count + total) + JOINT * m + 1]
        at = EACH * (count + m)
        place = wp.vec3f(objects[row, at], objects[row, at + 1], objects[row, at + 2])
        turned = wp.quatf(
            objects[row, at + 3], objects[row, at + 4], objects[row, at + 5], objects[row, at + 6]
        )
        handle = grips[m]  # of the case's frame, as far open
        if slides[m] != 0:
            handle += axes[m] * opened
        else:
            swing = wp.quat_from_axis_angle(axes[m], opened)
            handle = hinges[m] + wp.quat_rotate(swing, handle - hinges[m])
            turned = turned * wp.quat_inverse(swing)
        bases[world, m] = wp.transformf(place - wp.quat_rotate(turned, handle), turned)
    for i in range(3):
        task_goal[world, i] = goal[row, i]
