# pyright: reportIndexIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false, reportAssignmentType=false, reportReturnType=false
# (Kernels are Warp's language: pyright knows neither its arrays nor its vectors.)
"""Fingers and objects: commands, places, observations, and worlds that are to end.

``rest_q`` and ``rest_qd`` are what Newton's joints have beyond the arm's seven: two fingers, then 7 coordinates (x y z and
a quaternion x y z w) and 6 speeds of each object, then one of each articulated body (``articulated.py``).
"""

# Warp reads annotations as types: no `from __future__ import annotations` here.
import warp as wp

from franka_wm.envs.constants import (
    HAND_DIM,
    JOINT_DIM,
    MOST_OPEN,
    NUM_FINGERS,
    NUM_JOINTS,
    OBJECT_DIM,
    STATE_DIM,
)
from franka_wm.envs.kernels.functions import away_from, away_from_box, episode_rng

FINGERS = wp.constant(NUM_FINGERS)
ARM = wp.constant(NUM_JOINTS)
OPEN = wp.constant(MOST_OPEN)
HAND = wp.constant(STATE_DIM)
"""Where the hand's numbers begin in a state."""
HAND_END = wp.constant(STATE_DIM + HAND_DIM)
EACH = wp.constant(OBJECT_DIM)
JOINT = wp.constant(JOINT_DIM)
ATTEMPTS = wp.constant(64)
DRAWS = wp.constant(32)


@wp.kernel(enable_backward=False)
def spread_mask(mask: wp.array[wp.bool], each: int, out: wp.array[wp.bool]):
    """A mask of worlds as one of articulations: the arm and every object are one each."""
    world = wp.tid()
    for k in range(each):
        out[world * each + k] = mask[world]


@wp.kernel(enable_backward=False)
def apply_grip(
    action: wp.array2d[float],
    per_step: float,
    # in and out
    grip: wp.array[float],
    # output
    rest_control: wp.array2d[float],
):
    """The last action as the set point of both fingers, −1 closed and 1 open, which moves at most ``per_step`` [m]."""
    world = wp.tid()
    a = action[world, action.shape[1] - 1]
    wish = 0.5 * OPEN * (wp.clamp(a, -1.0, 1.0) + 1.0)
    value = grip[world] + wp.clamp(wish - grip[world], -per_step, per_step)
    if not wp.isfinite(a):
        value = wp.nan  # clamping would hide it; the world is then caught, reset and counted
    grip[world] = value
    for f in range(FINGERS):
        rest_control[world, f] = value


@wp.func
def away_from_obstacles(x: float, y: float, blocked: wp.array2d[float]) -> float:
    """From a point to the nearest of what :meth:`Scene.blocked` says [m]."""
    least = float(wp.inf)
    for o in range(blocked.shape[0]):  # x, y, half sides, cosine and sine of the angle, radius
        there = wp.vec2f(blocked[o, 0], blocked[o, 1])
        away = away_from_box(x, y, there, blocked[o, 2], blocked[o, 3], blocked[o, 4], blocked[o, 5])
        least = wp.min(least, away - blocked[o, 6])
    return least


@wp.kernel(enable_backward=False)
def place(
    mask: wp.array[wp.bool],
    seed: wp.array[int],
    episode: wp.array[int],
    middle: wp.array2d[float],
    spread: wp.array2d[float],
    turn: wp.array[float],
    height: wp.array[float],
    radius: wp.array[float],
    rise: wp.array[float],
    sizes: wp.array2d[float],
    raised: wp.array[float],
    blocked: wp.array2d[float],
    margin: float,
    bases: wp.array2d[wp.transformf],
    footprints: wp.array2d[float],
    # outputs
    rest_q: wp.array2d[float],
    rest_qd: wp.array2d[float],
    rest_control: wp.array2d[float],
    grip: wp.array[float],
    contacts: wp.array2d[float],
    history: wp.array3d[float],
):
    """New episodes of the masked worlds: fingers open, objects at rest where nothing else stands.

    ``height`` and ``radius`` are those of an object of its plain size on a table that is not ``raised``, ``rise`` the
    half of its own height [m].
    A place is drawn anew while something stands there, and where none is left all of them are. A scene in which that
    happens often is refused when it is made.
    """
    world = wp.tid()
    if not mask[world]:
        return
    for f in range(FINGERS):
        rest_q[world, f] = OPEN
        rest_control[world, f] = OPEN
    grip[world] = OPEN
    for f in range(contacts.shape[1]):
        contacts[world, f] = 0.0
    for j in range(rest_qd.shape[1]):
        rest_qd[world, j] = 0.0
    for k in range(history.shape[1]):
        history[world, k, history.shape[2] - 1] = 1.0  # what a late action leaves in force
    rng = episode_rng(seed[0], seed[1] + world, episode[world], 8)
    placed = bool(False)
    for _draw in range(DRAWS):
        if not placed:
            placed = bool(True)
            for b in range(turn.shape[0]):
                at = FINGERS + 7 * b
                wide = radius[b] * sizes[world, b] + margin
                found = bool(False)
                x = float(0.0)
                y = float(0.0)
                for _attempt in range(ATTEMPTS):
                    if not found:
                        x = middle[b, 0] + spread[b, 0] * wp.randf(rng, -1.0, 1.0)
                        y = middle[b, 1] + spread[b, 1] * wp.randf(rng, -1.0, 1.0)
                        found = away_from_obstacles(x, y, blocked) >= wide
                        for o in range(footprints.shape[0]):
                            found = found and away_from(x, y, bases[world, o], footprints, o) >= wide
                        for o in range(b):
                            there = wp.vec2f(
                                rest_q[world, FINGERS + 7 * o], rest_q[world, FINGERS + 7 * o + 1]
                            )
                            away = wp.length(wp.vec2f(x, y) - there)
                            found = found and away >= wide + radius[o] * sizes[world, o]
                placed = placed and found
                angle = turn[b] * wp.randf(rng, -1.0, 1.0)
                rest_q[world, at] = x
                rest_q[world, at + 1] = y
                rest_q[world, at + 2] = height[b] + (sizes[world, b] - 1.0) * rise[b] + raised[world]
                rest_q[world, at + 3] = 0.0
                rest_q[world, at + 4] = 0.0
                rest_q[world, at + 5] = wp.sin(0.5 * angle)
                rest_q[world, at + 6] = wp.cos(0.5 * angle)


@wp.kernel(enable_backward=False)
def observe(
    rest_q: wp.array2d[float],
    rest_qd: wp.array2d[float],
    body_q: wp.array2d[wp.transformf],
    tool_body: int,
    tool_frame: wp.array[wp.transformf],
    grip: wp.array[float],
    count: int,
    # outputs
    state: wp.array2d[float],
    joint_target: wp.array2d[float],
    objects: wp.array2d[float],
):
    """The hand's part of ``state`` and ``joint_target``, and 13 numbers of each of ``count`` objects.

    Of the two quaternions of an orientation the tool's has x ≥ 0 (its x is 1 where it points down), an object's w ≥ 0.
    """
    world = wp.tid()
    for f in range(FINGERS):
        state[world, HAND + f] = rest_q[world, f]
        state[world, HAND + FINGERS + f] = rest_qd[world, f]
    turned = wp.transform_get_rotation(body_q[world, tool_body]) * wp.transform_get_rotation(tool_frame[0])
    sign = wp.where(turned[0] < 0.0, -1.0, 1.0)
    for i in range(4):
        state[world, HAND + 2 * FINGERS + i] = sign * turned[i]
    joint_target[world, ARM] = grip[world]
    for b in range(count):
        at = FINGERS + 7 * b
        speed = FINGERS + 6 * b
        out = EACH * b
        sign = wp.where(rest_q[world, at + 6] < 0.0, -1.0, 1.0)
        for i in range(3):
            objects[world, out + i] = rest_q[world, at + i]
        for i in range(4):
            objects[world, out + 3 + i] = sign * rest_q[world, at + 3 + i]
        for i in range(6):
            objects[world, out + 7 + i] = rest_qd[world, speed + i]


@wp.kernel(enable_backward=False)
def mark_nonfinite(
    rest_q: wp.array2d[float], rest_qd: wp.array2d[float], grip: wp.array[float], state: wp.array2d[float]
):
    """Lets a world whose fingers, objects or grip are no longer finite be caught with its arm."""
    world = wp.tid()
    ok = wp.isfinite(grip[world])  # which the limit of the fingers' force would hide
    for j in range(rest_q.shape[1]):
        ok = ok and wp.isfinite(rest_q[world, j])
    for j in range(rest_qd.shape[1]):
        ok = ok and wp.isfinite(rest_qd[world, j])
    if not ok:
        state[world, 0] = wp.nan


@wp.kernel(enable_backward=False)
def restore(
    broken: wp.array[wp.bool],
    last_state: wp.array2d[float],
    last_target: wp.array2d[float],
    last_objects: wp.array2d[float],
    count: int,
    joints: int,
    # outputs
    state: wp.array2d[float],
    joint_target: wp.array2d[float],
    objects: wp.array2d[float],
    rest_q: wp.array2d[float],
    rest_qd: wp.array2d[float],
    rest_control: wp.array2d[float],
    grip: wp.array[float],
    contacts: wp.array2d[float],
):
    """Puts fingers and objects of broken worlds back to their last finite observation, at rest."""
    world = wp.tid()
    if not broken[world]:
        return
    for i in range(HAND, HAND_END):
        state[world, i] = last_state[world, i]
    for f in range(contacts.shape[1]):
        contacts[world, f] = 0.0
    joint_target[world, ARM] = last_target[world, ARM]
    grip[world] = last_target[world, ARM]
    for f in range(FINGERS):
        rest_q[world, f] = last_state[world, HAND + f]
        rest_control[world, f] = last_target[world, ARM]
    for i in range(objects.shape[1]):
        objects[world, i] = last_objects[world, i]
    for b in range(count):
        for i in range(7):
            rest_q[world, FINGERS + 7 * b + i] = last_objects[world, EACH * b + i]
    for m in range(joints):
        opened = last_objects[world, EACH * (count + joints) + JOINT * m]
        rest_q[world, FINGERS + 7 * count + m] = opened
    for j in range(rest_qd.shape[1]):
        rest_qd[world, j] = 0.0


@wp.kernel(enable_backward=False)
def add_forces(
    count: wp.array[int],
    worlds: wp.array[int],
    geoms: wp.array[wp.vec2i],
    rows: wp.array2d[int],
    force: wp.array2d[float],
    finger: wp.array[int],
    contacts: wp.array2d[float],
):
    """Adds the normal force of each of MuJoCo's contacts to the finger that it is at. dim = contacts, at most."""
    contact = wp.tid()
    if contact >= count[0]:
        return
    row = rows[contact, 0]  # of elliptic cones the first row is the normal's
    if row < 0 or row >= force.shape[1]:
        return
    for side in range(2):
        geom = geoms[contact][side]
        if geom >= 0:
            f = finger[geom]
            if f >= 0:
                wp.atomic_add(contacts, worlds[contact], f, force[worlds[contact], row])


@wp.kernel(enable_backward=False)
def note_overflow(now: wp.array[int], capacity: int, overflow: wp.array[int]):
    """Keeps what a substep said: MuJoCo forgets it in the next one. Only bits of ``capacity`` lose contacts."""
    world = wp.tid()
    overflow[world] = overflow[world] | (now[world] & capacity)


@wp.kernel(enable_backward=False)
def note_lost(count: wp.array[int], most: int, overflow: wp.array[int]):
    """Notes in every world that there were more contacts than the ``most`` that all of them have room for."""
    if count[0] > most:
        overflow[wp.tid()] = 1


@wp.kernel(enable_backward=False)
def cap(most: int, count: wp.array[int]):
    count[0] = wp.min(count[0], most)


@wp.kernel(enable_backward=False)
def cut_short(
    objects: wp.array2d[float],
    count: int,
    overflow: wp.array[int],
    lost_ends: bool,
    center: wp.vec2f,
    half: wp.vec2f,
    lowest: float,
    raised: wp.array[float],
    ended: wp.array[wp.bool],
    column: int,
    # outputs
    cut: wp.array[wp.bool],
    statistics: wp.array2d[wp.float64],
):
    """Which worlds are to end: contacts were lost for want of room, or an object has left the table."""
    world = wp.tid()
    stop = overflow[world] != 0
    if stop and not ended[world]:
        statistics[world, column] += wp.float64(1.0)
    if lost_ends:
        for b in range(count):
            x = wp.abs(objects[world, EACH * b] - center[0])
            y = wp.abs(objects[world, EACH * b + 1] - center[1])
            stop = stop or x > half[0] or y > half[1] or objects[world, EACH * b + 2] < lowest + raised[world]
    cut[world] = stop
