# pyright: reportIndexIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false, reportAssignmentType=false, reportReturnType=false
# (Kernels are Warp's language: pyright knows neither its arrays nor its vectors.)
"""Ends of episodes with their statistics, and the start of the next."""

# Warp reads annotations as types: no `from __future__ import annotations` here.
import warp as wp

from franka_wm.envs.kernels.functions import JOINTS, episode_rng


@wp.kernel(enable_backward=False)
def end_step(
    reward: wp.array2d[float],
    broken: wp.array[wp.bool],
    overflow: wp.array[int],
    cut: wp.array[wp.bool],
    episode_length: int,
    terminate_on_success: bool,
    # in and out
    success: wp.array2d[wp.bool],
    step_count: wp.array2d[int],
    episode_return: wp.array2d[float],
    episode_success: wp.array2d[wp.bool],
    ended: wp.array[wp.bool],
    statistics: wp.array2d[wp.float64],
    # outputs
    terminated: wp.array2d[wp.bool],
    truncated: wp.array2d[wp.bool],
    done: wp.array2d[wp.bool],
    reset_mask: wp.array[wp.bool],
):
    """Ends episodes and keeps their statistics.

    A broken world is truncated, not terminated: where rewards are negative, as reach's are, an end worth 0 would
    pay an agent for breaking the simulation. Nor has it succeeded, wherever it was before, and neither has one whose
    contacts were lost (``overflow``): what it did is not known. A world that is ``cut``
    short is truncated, too: what comes then has no reward of its own, but is not worth 0 either. A world that is
    stepped on after its end, without a reset, stays done by time or success, and is not counted again.
    """
    world = wp.tid()
    over = ended[world]
    count = step_count[world, 0] + 1
    step_count[world, 0] = count
    total = episode_return[world, 0] + reward[world, 0]
    episode_return[world, 0] = total
    if broken[world] or overflow[world] != 0:
        success[world, 0] = False
    solved = success[world, 0] and not over
    once = episode_success[world, 0] or solved
    episode_success[world, 0] = once
    stops = terminate_on_success and once
    late = (count >= episode_length) or broken[world] or cut[world] or over
    terminated[world, 0] = stops
    truncated[world, 0] = late and not stops
    finished = stops or late
    ended[world] = finished
    done[world, 0] = finished
    reset_mask[world] = finished
    if finished and not over:
        statistics[world, 0] += wp.float64(1.0)
        statistics[world, 1] += wp.float64(total)
        statistics[world, 2] += wp.float64(float(count))
        if solved:
            statistics[world, 3] += wp.float64(1.0)
        if once:
            statistics[world, 4] += wp.float64(1.0)
    if broken[world] and not over:
        statistics[world, 5] += wp.float64(1.0)


@wp.kernel(enable_backward=False)
def reset_pose(
    mask: wp.array[wp.bool],
    seed: wp.array[int],
    home: wp.array[float],
    noise: float,
    lower: wp.array[float],
    upper: wp.array[float],
    # in and out
    episode: wp.array[int],
    # outputs
    joint_q: wp.array2d[float],
    joint_qd: wp.array2d[float],
    target: wp.array2d[float],
    control: wp.array2d[float],
    step_count: wp.array2d[int],
    episode_return: wp.array2d[float],
    episode_success: wp.array2d[wp.bool],
    ended: wp.array[wp.bool],
    history: wp.array3d[float],
    absolute: bool,
):
    """Starts the next episode of the masked worlds: home pose plus noise, at rest, targets at the pose."""
    world = wp.tid()
    if not mask[world]:
        return
    number = episode[world] + 1
    episode[world] = number
    rng = episode_rng(seed[0], seed[1] + world, number, 0)
    for j in range(JOINTS):
        angle = wp.clamp(home[j] + wp.randf(rng, -noise, noise), lower[j], upper[j])
        joint_q[world, j] = angle
        joint_qd[world, j] = 0.0
        target[world, j] = angle
        control[world, j] = angle
    step_count[world, 0] = 0
    episode_return[world, 0] = 0.0
    episode_success[world, 0] = False
    ended[world] = False
    for k in range(history.shape[1]):
        for j in range(history.shape[2]):
            history[world, k, j] = 0.0
            if (
                absolute and j < JOINTS
            ):  # what a late action leaves in force is the pose, not the middle of the limits
                middle = 0.5 * (lower[j] + upper[j])
                history[world, k, j] = (target[world, j] - middle) / (0.5 * (upper[j] - lower[j]))
