# pyright: reportIndexIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false, reportAssignmentType=false, reportReturnType=false
# (Kernels are Warp's language: pyright knows neither its arrays nor its vectors.)
"""What is observed of the arm, and worlds that are no longer finite."""

# Warp reads annotations as types: no `from __future__ import annotations` here.
import warp as wp

from franka_wm.envs.constants import OBJECT_DIM
from franka_wm.envs.kernels.functions import JOINTS, STATE, episode_rng

EACH = wp.constant(OBJECT_DIM)


@wp.kernel(enable_backward=False)
def observe(
    joint_q: wp.array2d[float],
    joint_qd: wp.array2d[float],
    body_q: wp.array2d[wp.transformf],
    tool_body: int,
    tool_frame: wp.array[wp.transformf],
    target: wp.array2d[float],
    goal: wp.array2d[float],
    # outputs
    state: wp.array2d[float],
    joint_target: wp.array2d[float],
    goal_out: wp.array2d[float],
):
    """Writes the 20 numbers of ``state`` and copies of the target and goal."""
    world = wp.tid()
    tool = wp.transform_point(body_q[world, tool_body], wp.transform_get_translation(tool_frame[0]))
    for j in range(JOINTS):
        state[world, j] = joint_q[world, j]
        state[world, JOINTS + j] = joint_qd[world, j]
        joint_target[world, j] = target[world, j]
    for i in range(3):
        state[world, 14 + i] = tool[i]
        state[world, 17 + i] = tool[i] - goal[world, i]
        goal_out[world, i] = goal[world, i]


@wp.kernel(enable_backward=False)
def blur_state(
    seed: wp.array[int],
    episode: wp.array[int],
    step_count: wp.array2d[int],
    noise: float,
    state: wp.array2d[float],
    out: wp.array2d[float],
):
    """``state`` as seen: noise on joint angles and, ten times as much, on velocities."""
    world = wp.tid()
    rng = wp.rand_init(int(episode_rng(seed[0], seed[1] + world, episode[world], 3)), step_count[world, 0])
    for i in range(state.shape[1]):
        value = state[world, i]
        if i < JOINTS:
            value += noise * wp.randn(rng)
        elif i < 2 * JOINTS:
            value += 10.0 * noise * wp.randn(rng)
        out[world, i] = value


@wp.kernel(enable_backward=False)
def blur_objects(
    seed: wp.array[int],
    episode: wp.array[int],
    step_count: wp.array2d[int],
    noise: float,
    bodies: int,
    objects: wp.array2d[float],
    out: wp.array2d[float],
):
    """``objects`` as seen: noise on the positions of the first so many ``bodies``."""
    world = wp.tid()
    rng = wp.rand_init(int(episode_rng(seed[0], seed[1] + world, episode[world], 15)), step_count[world, 0])
    for i in range(objects.shape[1]):
        value = objects[world, i]
        if i < EACH * bodies and i % EACH < 3:
            value += noise * wp.randn(rng)
        out[world, i] = value


@wp.kernel(enable_backward=False)
def catch_nonfinite(
    last_state: wp.array2d[float],
    last_target: wp.array2d[float],
    # in and out
    state: wp.array2d[float],
    joint_target: wp.array2d[float],
    target: wp.array2d[float],
    joint_q: wp.array2d[float],
    joint_qd: wp.array2d[float],
    # output
    broken: wp.array[wp.bool],
):
    """Puts a world that is no longer finite back to its last finite observation and marks it broken."""
    world = wp.tid()
    ok = bool(True)
    for i in range(STATE):
        ok = ok and wp.isfinite(state[world, i])
    for j in range(JOINTS):
        ok = ok and wp.isfinite(joint_target[world, j])
    broken[world] = not ok
    if not ok:
        for i in range(STATE):
            state[world, i] = last_state[world, i]
        for j in range(JOINTS):
            joint_target[world, j] = last_target[world, j]
            target[world, j] = last_target[world, j]
            joint_q[world, j] = last_state[world, j]
            joint_qd[world, j] = 0.0
