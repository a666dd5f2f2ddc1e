# pyright: reportIndexIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false, reportAssignmentType=false, reportReturnType=false
# (Kernels are Warp's language: pyright knows neither its arrays nor its vectors.)
"""What each episode draws anew.

A generator must be advanced where it lives: a function that took it would advance a copy, and every draw
would be the same one.
"""

# Warp reads annotations as types: no `from __future__ import annotations` here.
import warp as wp

from franka_wm.envs.constants import NUM_FINGERS
from franka_wm.envs.kernels.functions import JOINTS, episode_rng

FINGERS = wp.constant(NUM_FINGERS)


@wp.kernel(enable_backward=False)
def draw_looks(
    mask: wp.array[wp.bool],
    seed: wp.array[int],
    episode: wp.array[int],
    color: float,
    brightness: float,
    eye: wp.vec3f,
    at: wp.vec3f,
    eye_noise: float,
    at_noise: float,
    latency: int,
    shapes: int,
    plain: wp.array2d[wp.vec3f],
    # outputs
    colors: wp.array2d[wp.vec3f],
    level: wp.array[float],
    poses: wp.array[wp.transformf],
    delay: wp.array[int],
):
    """Colours, brightness, camera and delay of the masked worlds' new episodes."""
    world = wp.tid()
    if not mask[world]:
        return
    rng = episode_rng(seed[0], seed[1] + world, episode[world], 4)
    level[world] = 1.0 + wp.randf(rng, -brightness, brightness)
    e = (
        eye
        + wp.vec3f(wp.randf(rng, -1.0, 1.0), wp.randf(rng, -1.0, 1.0), wp.randf(rng, -1.0, 1.0)) * eye_noise
    )
    t = at + wp.vec3f(wp.randf(rng, -1.0, 1.0), wp.randf(rng, -1.0, 1.0), wp.randf(rng, -1.0, 1.0)) * at_noise
    back = wp.normalize(e - t)
    vertical = wp.vec3f(0.0, 0.0, 1.0)
    right = wp.cross(vertical, back)
    if wp.length(wp.cross(vertical, wp.normalize(eye - at))) < 1.0e-6:
        # Straight up or down: y is to the right, as in look_at. Else a small offset could turn the image by any angle.
        right = wp.vec3f(0.0, 1.0, 0.0) - back * back[1]
    right = wp.normalize(right)
    up = wp.cross(back, right)
    poses[world] = wp.transformf(e, wp.quat_from_matrix(wp.matrix_from_cols(right, up, back)))
    delay[world] = wp.min(int(wp.randf(rng) * float(latency + 1)), latency)
    if color > 0.0:
        for k in range(shapes):
            c = plain[world, k]
            for i in range(3):
                c[i] = wp.clamp(c[i] + wp.randf(rng, -color, color), 0.0, 1.0)
            colors[world, k] = c


@wp.kernel(enable_backward=False)
def any_masked(mask: wp.array[wp.bool], found: wp.array[int]):
    if mask[wp.tid()]:
        found[0] = 1


@wp.kernel(enable_backward=False)
def draw_dynamics(
    mask: wp.array[wp.bool],
    seed: wp.array[int],
    episode: wp.array[int],
    gains: float,
    armature_width: float,
    friction_most: float,
    mass_width: float,
    plain_ke: wp.array2d[float],
    plain_kd: wp.array2d[float],
    plain_armature: wp.array2d[float],
    plain_mass: wp.array2d[float],
    plain_inertia: wp.array2d[wp.mat33f],
    # outputs
    ke: wp.array2d[float],
    kd: wp.array2d[float],
    armature: wp.array2d[float],
    friction: wp.array2d[float],
    mass: wp.array2d[float],
    inertia: wp.array2d[wp.mat33f],
):
    """Servo, joints and links of the masked worlds' new episodes."""
    world = wp.tid()
    if not mask[world]:
        return
    rng = episode_rng(seed[0], seed[1] + world, episode[world], 5)
    for j in range(wp.min(ke.shape[1], JOINTS)):  # the arm's joints
        ke[world, j] = plain_ke[world, j] * (1.0 + wp.randf(rng, -gains, gains))
        kd[world, j] = plain_kd[world, j] * (1.0 + wp.randf(rng, -gains, gains))
        armature[world, j] = plain_armature[world, j] * (1.0 + wp.randf(rng, -armature_width, armature_width))
        drawn = wp.randf(rng)
        if friction_most > 0.0:
            friction[world, j] = friction_most * drawn
    for b in range(mass.shape[1]):
        f = 1.0 + wp.randf(rng, -mass_width, mass_width)
        mass[world, b] = plain_mass[world, b] * f
        inertia[world, b] = plain_inertia[world, b] * f


@wp.kernel(enable_backward=False)
def draw_sizes(
    mask: wp.array[wp.bool],
    seed: wp.array[int],
    episode: wp.array[int],
    width: float,
    first: int,
    # outputs
    sizes: wp.array2d[float],
    mass: wp.array2d[float],
    inertia: wp.array2d[wp.mat33f],
):
    """Sizes of the objects, bodies ``first`` and on, of the masked worlds' new episodes; their density stays.

    Masses and inertias are multiplied in place: :func:`draw_dynamics` has just written them.
    """
    world = wp.tid()
    if mask[world]:
        rng = episode_rng(seed[0], seed[1] + world, episode[world], 12)
        for k in range(sizes.shape[1]):
            f = 1.0 + wp.randf(rng, -width, width)
            sizes[world, k] = f
            mass[world, first + k] = mass[world, first + k] * f * f * f
            inertia[world, first + k] = inertia[world, first + k] * (f * f * f * f * f)


@wp.kernel(enable_backward=False)
def resize(
    sizes: wp.array2d[float],
    parts: wp.array[wp.vec3i],
    plain_size: wp.array[wp.vec3f],
    plain_bounds: wp.array2d[wp.vec3f],
    plain_radius: wp.array[float],
    plain_place: wp.array[wp.vec3f],
    plain_scale: wp.array2d[wp.vec3f],
    plain_frame: wp.array2d[wp.transformf],
    plain_com: wp.array2d[wp.vec3f],
    first: int,
    # outputs
    size: wp.array2d[wp.vec3f],
    bounds: wp.array3d[wp.vec3f],
    radius: wp.array2d[float],
    place: wp.array2d[wp.vec3f],
    scale: wp.array2d[wp.vec3f],
    frame: wp.array2d[wp.transformf],
    com: wp.array2d[wp.vec3f],
):
    """What MuJoCo touches and what cameras see of the objects, bodies ``first`` and on, and their centres of mass.

    dim = (worlds, parts); a part is MuJoCo's geom, Newton's shape, both counted in a world, and the object.
    """
    world, k = wp.tid()  # pyright: ignore
    geom = parts[k][0]
    shape = parts[k][1]
    f = sizes[world, parts[k][2]]
    size[world, geom] = plain_size[geom] * f
    for i in range(2):
        bounds[world, geom, i] = plain_bounds[geom, i] * f
    radius[world, geom] = plain_radius[geom] * f
    place[world, geom] = plain_place[geom] * f
    scale[world, shape] = plain_scale[world, shape] * f
    at = plain_frame[world, shape]
    frame[world, shape] = wp.transformf(wp.transform_get_translation(at) * f, wp.transform_get_rotation(at))
    body = first + parts[k][2]
    com[world, body] = plain_com[world, body] * f


@wp.kernel(enable_backward=False)
def draw_table(
    mask: wp.array[wp.bool],
    seed: wp.array[int],
    episode: wp.array[int],
    width: float,
    # output
    raised: wp.array[float],
):
    """Height of the table in the masked worlds' new episodes."""
    world = wp.tid()
    if mask[world]:
        rng = episode_rng(seed[0], seed[1] + world, episode[world], 13)
        raised[world] = wp.randf(rng, -width, width)


@wp.kernel(enable_backward=False)
def raise_table(
    raised: wp.array[float],
    parts: wp.array[wp.vec2i],
    plain_place: wp.array2d[wp.vec3f],
    plain_frame: wp.array2d[wp.transformf],
    # outputs
    place: wp.array2d[wp.vec3f],
    frame: wp.array2d[wp.transformf],
):
    """What MuJoCo touches and what cameras see of table and obstacles. dim = (worlds, parts); a part is Newton's shape
    and MuJoCo's geom, both counted in a world, −1 where there is none.

    Of what never moves MuJoCo reads places in the world, ``place``, which it derived once from those in its model.
    """
    world, k = wp.tid()  # pyright: ignore
    up = wp.vec3f(0.0, 0.0, raised[world])
    shape = parts[k][0]
    geom = parts[k][1]
    at = plain_frame[world, shape]
    frame[world, shape] = wp.transformf(wp.transform_get_translation(at) + up, wp.transform_get_rotation(at))
    if geom >= 0:
        place[world, geom] = plain_place[world, geom] + up


@wp.kernel(enable_backward=False)
def draw_frictions(
    mask: wp.array[wp.bool],
    seed: wp.array[int],
    episode: wp.array[int],
    width: float,
    plain: wp.array2d[wp.vec3f],
    # output
    friction: wp.array2d[wp.vec3f],
):
    """Friction of all that is touched in the masked worlds' new episodes."""
    world = wp.tid()
    if mask[world]:
        rng = episode_rng(seed[0], seed[1] + world, episode[world], 10)
        for g in range(plain.shape[1]):
            friction[world, g] = plain[world, g] * (1.0 + wp.randf(rng, -width, width))


@wp.kernel(enable_backward=False)
def draw_grip(
    mask: wp.array[wp.bool],
    seed: wp.array[int],
    episode: wp.array[int],
    width: float,
    plain_ke: wp.array2d[float],
    plain_limit: wp.array2d[float],
    # outputs
    ke: wp.array2d[float],
    limit: wp.array2d[float],
):
    """How hard both fingers squeeze in the masked worlds' new episodes."""
    world = wp.tid()
    if mask[world]:
        rng = episode_rng(seed[0], seed[1] + world, episode[world], 11)
        f = 1.0 + wp.randf(rng, -width, width)
        for j in range(JOINTS, JOINTS + FINGERS):
            ke[world, j] = plain_ke[world, j] * f
            limit[world, j] = plain_limit[world, j] * f


@wp.kernel(enable_backward=False)
def draw_uniform(
    mask: wp.array[wp.bool], seed: wp.array[int], episode: wp.array[int], draws: wp.array2d[float]
):
    """Numbers in [0, 1) for the tasks of the masked worlds' new episodes."""
    world = wp.tid()
    if mask[world]:
        rng = episode_rng(seed[0], seed[1] + world, episode[world], 7)
        for k in range(draws.shape[1]):
            draws[world, k] = wp.randf(rng)
