# pyright: reportIndexIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false, reportAssignmentType=false, reportReturnType=false
# (Kernels are Warp's language: pyright knows neither its arrays nor its vectors.)
"""From actions to the set points of the servo."""

# Warp reads annotations as types: no `from __future__ import annotations` here.
import warp as wp

from franka_wm.envs.kernels.functions import JOINTS, episode_rng


@wp.kernel(enable_backward=False)
def perceive_action(
    action: wp.array2d[float],
    seed: wp.array[int],
    episode: wp.array[int],
    step_count: wp.array2d[int],
    delay: wp.array[int],
    noise: float,
    # in and out
    history: wp.array3d[float],
    # output
    applied: wp.array2d[float],
):
    """What of the agent's action arrives at the arm: late and noisy, if asked for.

    ``history`` (worlds, slots, actions) is a ring that the episode's step number turns; its slots mean
    "stay" at the start of an episode.
    """
    world = wp.tid()
    slots = history.shape[1]
    now = step_count[world, 0] % slots
    then = (step_count[world, 0] + slots - delay[world]) % slots
    rng = wp.rand_init(int(episode_rng(seed[0], seed[1] + world, episode[world], 2)), step_count[world, 0])
    for j in range(action.shape[1]):
        history[world, now, j] = action[world, j]
        value = history[world, then, j]
        if noise > 0.0:
            value += noise * wp.randn(rng)
        applied[world, j] = value


@wp.kernel(enable_backward=False)
def apply_joint_action(
    action: wp.array2d[float],
    absolute: bool,
    scale: float,
    lower: wp.array[float],
    upper: wp.array[float],
    lead: wp.array[float],
    joint_q: wp.array2d[float],
    target: wp.array2d[float],
    control: wp.array2d[float],
):
    """Actions to the servo's targets: added to them, or in place of them. dim = (worlds, joints).

    A target may not run ahead of its joint by more than ``lead`` plus one action: what the arm cannot follow
    would otherwise pile up and be paid back later, in the wrong direction.
    """
    world, j = wp.tid()  # pyright: ignore
    a = action[world, j]
    value = target[world, j] + scale * wp.clamp(a, -1.0, 1.0)
    if absolute:
        value = 0.5 * (lower[j] + upper[j]) + 0.5 * (upper[j] - lower[j]) * wp.clamp(a, -1.0, 1.0)
    slack = lead[j] + scale
    value = wp.clamp(value, joint_q[world, j] - slack, joint_q[world, j] + slack)
    value = wp.clamp(value, lower[j], upper[j])
    if not wp.isfinite(a):
        value = wp.nan  # clamping would hide it; the world is then caught, reset and counted
    target[world, j] = value
    control[world, j] = value


@wp.kernel(enable_backward=False)
def apply_tool_action(
    action: wp.array2d[float],
    scale: float,
    largest: float,
    lower: wp.array[float],
    upper: wp.array[float],
    lead: wp.array[float],
    parent_frames: wp.array[wp.transformf],
    child_frames: wp.array[wp.transformf],
    axes: wp.array[wp.vec3f],
    tool_frame: wp.array[wp.transformf],
    joint_q: wp.array2d[float],
    origins: wp.array2d[wp.vec3f],
    directions: wp.array2d[wp.vec3f],
    target: wp.array2d[float],
    control: wp.array2d[float],
):
    """Tool displacements to joint targets: one damped least-squares step (Wampler 1986) at the targets.

    Where a joint would move by more than ``largest``, all move by the same share less: the tool keeps its direction, until
    a joint meets its limit or runs ahead of what it can follow.
    """
    world = wp.tid()
    frame = wp.transform_identity(dtype=float)
    for j in range(JOINTS):
        frame = frame * parent_frames[j]
        origins[world, j] = wp.transform_get_translation(frame)
        directions[world, j] = wp.transform_vector(frame, axes[j])
        turn = wp.transformf(wp.vec3f(0.0, 0.0, 0.0), wp.quat_from_axis_angle(axes[j], target[world, j]))
        frame = frame * turn * wp.transform_inverse(child_frames[j])
    tool = wp.transform_get_translation(frame * tool_frame[0])
    gram = wp.identity(n=3, dtype=float) * 1.0e-3
    for j in range(JOINTS):
        column = wp.cross(directions[world, j], tool - origins[world, j])
        gram += wp.outer(column, column)
    wish = wp.vec3f(
        wp.clamp(action[world, 0], -1.0, 1.0),
        wp.clamp(action[world, 1], -1.0, 1.0),
        wp.clamp(action[world, 2], -1.0, 1.0),
    )
    pull = wp.inverse(gram) * (wish * scale)
    most = float(0.0)
    for j in range(JOINTS):
        column = wp.cross(directions[world, j], tool - origins[world, j])
        most = wp.max(most, wp.abs(wp.dot(column, pull)))
    pull *= wp.min(1.0, largest / wp.max(most, 1.0e-9))
    finite = wp.isfinite(action[world, 0]) and wp.isfinite(action[world, 1]) and wp.isfinite(action[world, 2])
    for j in range(JOINTS):
        column = wp.cross(directions[world, j], tool - origins[world, j])
        value = target[world, j] + wp.dot(column, pull)
        slack = lead[j] + largest
        value = wp.clamp(value, joint_q[world, j] - slack, joint_q[world, j] + slack)
        value = wp.clamp(value, lower[j], upper[j])
        if not finite:
            value = wp.nan
        target[world, j] = value
        control[world, j] = value


@wp.kernel(enable_backward=False)
def limit_speed(
    target: wp.array2d[float],
    lead: wp.array[float],
    joint_q: wp.array2d[float],
    control: wp.array2d[float],
):
    """Keeps the servo's set point within ``lead`` of the joint. dim = (worlds, joints); before every substep.

    The servo's torque is ke·(set point − q) − kd·q̇, so with lead = kd·v/ke it never pushes a joint that
    already moves at v.
    """
    world, j = wp.tid()  # pyright: ignore
    q = joint_q[world, j]
    control[world, j] = wp.clamp(target[world, j], q - lead[j], q + lead[j])
