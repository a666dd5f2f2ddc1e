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
    """A generator that depends on nothing but these four: not on N, not on the order of resets.

    Streams: 0 start, 1 goal, 2 action noise, 3 noise on states, 4 looks, 5 joints and masses, 6 phase of a moving goal,
    7 :func:`draw_uniform` (a task's numbers), 8 places of bodies, 9 of drawers and doors, 10 grip, 11 delay, 12 sizes,
    13 friction of contacts, 14 states of demonstrations, 15 noise on objects; 16 and up are for tasks of one's own.
    """
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


@wp.func
def away_from_box(
    x: float, y: float, at: wp.vec2f, half_u: float, half_v: float, cos: float, sin: float
) -> float:
    """Distance of a point to an upright box on the table [m], given its middle, half sides and angle."""
    dx = x - at[0]
    dy = y - at[1]
    u = wp.max(wp.abs(cos * dx + sin * dy) - half_u, 0.0)
    v = wp.max(wp.abs(cos * dy - sin * dx) - half_v, 0.0)
    return wp.length(wp.vec2f(u, v))


@wp.func
def away_from_solids(at: wp.vec3f, raised: float, solids: wp.array2d[float]) -> float:
    """From a point to the nearest box of :attr:`Scene.solids` [m], of a table that is so much higher."""
    least = float(wp.inf)
    for s in range(solids.shape[0]):  # x, y, z, half sides, cosine and sine of the angle
        middle = wp.vec2f(solids[s, 0], solids[s, 1])
        flat = away_from_box(at[0], at[1], middle, solids[s, 3], solids[s, 4], solids[s, 6], solids[s, 7])
        up = wp.max(wp.abs(at[2] - raised - solids[s, 2]) - solids[s, 5], 0.0)
        least = wp.min(least, wp.length(wp.vec2f(flat, up)))
    return least


@wp.func
def away_from(x: float, y: float, base: wp.transformf, footprints: wp.array2d[float], body: int) -> float:
    """Distance of a point to what an articulated body takes of the table [m]; rows: middle x, y, half sides."""
    turn = wp.transform_get_rotation(base)
    at = wp.transform_point(base, wp.vec3f(footprints[body, 0], footprints[body, 1], 0.0))
    cos = 1.0 - 2.0 * turn[2] * turn[2]
    sin = 2.0 * turn[2] * turn[3]
    half_u = footprints[body, 2]
    half_v = footprints[body, 3]
    return away_from_box(x, y, wp.vec2f(at[0], at[1]), half_u, half_v, cos, sin)
