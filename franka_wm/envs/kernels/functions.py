# pyright: reportIndexIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false, reportAssignmentType=false, reportReturnType=false
# (Kernels are Warp's language: pyright knows neither its arrays nor its vectors.)
"""Functions and sizes that the kernels share."""

# Warp reads annotations as types: no `from __future__ import annotations` here.
import warp as wp

JOINTS = wp.constant(7)
STATE = wp.constant(20)


@wp.func
def episode_rng(seed: int, world: int, episode: int, stream: int) -> wp.uint32:
    """A generator that depends on nothing but these four: not on N, not on the order of resets."""
    return wp.rand_init(int(wp.rand_init(int(wp.rand_init(seed, world)), episode)), stream)


@wp.func
def chain_forward(
    q: wp.array2d[float],
    world: int,
    parent_frames: wp.array[wp.transformf],
    child_frames: wp.array[wp.transformf],
    axes: wp.array[wp.vec3f],
    tool_frame: wp.array[wp.transformf],
) -> wp.vec3f:
    """Tool position [m] of the joint angles ``q[world]``."""
    frame = wp.transform_identity(dtype=float)
    for j in range(JOINTS):
        turn = wp.transformf(wp.vec3f(0.0, 0.0, 0.0), wp.quat_from_axis_angle(axes[j], q[world, j]))
        frame = frame * parent_frames[j] * turn * wp.transform_inverse(child_frames[j])
    return wp.transform_get_translation(frame * tool_frame[0])
