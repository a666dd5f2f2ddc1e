# pyright: reportIndexIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false, reportAssignmentType=false, reportReturnType=false
# (Kernels are Warp's language: pyright knows neither its arrays nor its vectors.)
"""The Warp kernels of a control step. One thread per world unless said otherwise.

Python numbers given to a captured launch are frozen into the graph, so whatever may change (seed, masks,
counters) lives in device arrays.
"""

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
    rng = wp.rand_init(int(episode_rng(seed[0], world, episode[world], 2)), step_count[world, 0])
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
    """Tool displacements to joint targets: one damped least-squares step (Wampler 1986) at the targets."""
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
    finite = wp.isfinite(action[world, 0]) and wp.isfinite(action[world, 1]) and wp.isfinite(action[world, 2])
    for j in range(JOINTS):
        column = wp.cross(directions[world, j], tool - origins[world, j])
        value = target[world, j] + wp.clamp(wp.dot(column, pull), -largest, largest)
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
    rng = wp.rand_init(int(episode_rng(seed[0], world, episode[world], 3)), step_count[world, 0])
    for i in range(STATE):
        value = state[world, i]
        if i < JOINTS:
            value += noise * wp.randn(rng)
        elif i < 2 * JOINTS:
            value += 10.0 * noise * wp.randn(rng)
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


@wp.kernel(enable_backward=False)
def end_step(
    reward: wp.array2d[float],
    success: wp.array2d[wp.bool],
    broken: wp.array[wp.bool],
    episode_length: int,
    terminate_on_success: bool,
    # in and out
    step_count: wp.array2d[int],
    episode_return: wp.array2d[float],
    episode_success: wp.array2d[wp.bool],
    statistics: wp.array2d[wp.float64],
    # outputs
    terminated: wp.array2d[wp.bool],
    truncated: wp.array2d[wp.bool],
    done: wp.array2d[wp.bool],
    reset_mask: wp.array[wp.bool],
):
    """Ends episodes and keeps their statistics.

    A broken world is truncated, not terminated: all rewards are negative, so an end worth 0 would pay an
    agent for breaking the simulation. A world that is stepped on after its end, without a reset, stays done by
    time or success, and is not counted again.
    """
    world = wp.tid()
    over = step_count[world, 0] >= episode_length or (terminate_on_success and episode_success[world, 0])
    count = step_count[world, 0] + 1
    step_count[world, 0] = count
    total = episode_return[world, 0] + reward[world, 0]
    episode_return[world, 0] = total
    solved = success[world, 0] and not broken[world]
    once = episode_success[world, 0] or solved
    episode_success[world, 0] = once
    ended = terminate_on_success and once
    late = (count >= episode_length) or broken[world]
    terminated[world, 0] = ended
    truncated[world, 0] = late and not ended
    finished = ended or late
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
    if broken[world]:
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
    history: wp.array3d[float],
    absolute: bool,
):
    """Starts the next episode of the masked worlds: home pose plus noise, at rest, targets at the pose."""
    world = wp.tid()
    if not mask[world]:
        return
    number = episode[world] + 1
    episode[world] = number
    rng = episode_rng(seed[0], world, number, 0)
    for j in range(JOINTS):
        angle = wp.clamp(home[j] + wp.randf(rng, -noise, noise), lower[j], upper[j])
        joint_q[world, j] = angle
        joint_qd[world, j] = 0.0
        target[world, j] = angle
        control[world, j] = angle
    step_count[world, 0] = 0
    episode_return[world, 0] = 0.0
    episode_success[world, 0] = False
    for k in range(history.shape[1]):
        for j in range(history.shape[2]):
            history[world, k, j] = 0.0
            if absolute:  # what a late action leaves in force is the pose, not the middle of the limits
                middle = 0.5 * (lower[j] + upper[j])
                history[world, k, j] = (target[world, j] - middle) / (0.5 * (upper[j] - lower[j]))


@wp.kernel(enable_backward=False)
def list_worlds(mask: wp.array[wp.bool], worlds: wp.array[int], counts: wp.array[int]):
    """Lists the masked worlds, in any order. ``counts`` is (how many, how many are rendered, is any left)."""
    world = wp.tid()
    if mask[world]:
        worlds[wp.atomic_add(counts, 0, 1)] = world
        counts[2] = 1


@wp.kernel(enable_backward=False)
def choose_views(worlds: wp.array[int], counts: wp.array[int], skip: int, views: wp.array[int]):
    """The next listed worlds, one for each view; views without one are skipped."""
    view = wp.tid()
    place = counts[1] + view
    views[view] = wp.where(place < counts[0], worlds[wp.min(place, worlds.shape[0] - 1)], skip)


@wp.kernel(enable_backward=False)
def place_pixels(views: wp.array[int], rendered: wp.array3d[wp.uint32], image: wp.array3d[wp.uint32]):
    """Copies each view to its world's picture. dim = (views, height, width)."""
    view, row, column = wp.tid()  # pyright: ignore
    world = views[view]
    if world >= 0:
        image[world, row, column] = rendered[view, row, column]


@wp.kernel(enable_backward=False)
def place_depth(views: wp.array[int], rendered: wp.array3d[wp.float32], image: wp.array3d[wp.float32]):
    """Copies each view to its world's picture. dim = (views, height, width)."""
    view, row, column = wp.tid()  # pyright: ignore
    world = views[view]
    if world >= 0:
        image[world, row, column] = rendered[view, row, column]


@wp.kernel(enable_backward=False)
def place_segmentation(views: wp.array[int], rendered: wp.array3d[wp.uint8], image: wp.array3d[wp.uint8]):
    """Copies each view to its world's picture. dim = (views, height, width)."""
    view, row, column = wp.tid()  # pyright: ignore
    world = views[view]
    if world >= 0:
        image[world, row, column] = rendered[view, row, column]


# One generic kernel would do, but a captured graph on the CPU replays the overload of another type (Warp 1.19).
PLACE = {"pixels": place_pixels, "depth": place_depth, "segmentation": place_segmentation}


@wp.kernel(enable_backward=False)
def advance_views(views: int, counts: wp.array[int], left: wp.array[int]):
    """One thread: counts the views that were rendered and says whether listed worlds are left."""
    counts[1] = counts[1] + views
    left[0] = wp.where(counts[1] < counts[0], 1, 0)


@wp.kernel(enable_backward=False)
def aim_wrist(
    body_q: wp.array2d[wp.transformf],
    tool_body: int,
    mount: wp.array[wp.transformf],
    views: wp.array[int],
    transforms: wp.array[wp.transformf],
):
    """Camera frames that ride on the hand."""
    view = wp.tid()
    world = views[view]
    if world >= 0:
        transforms[view] = body_q[world, tool_body] * mount[0]


@wp.kernel(enable_backward=False)
def aim_fixed(
    poses: wp.array[wp.transformf],
    turn: wp.transformf,
    views: wp.array[int],
    transforms: wp.array[wp.transformf],
):
    """Each view's world's own camera frame, turned in the world."""
    view = wp.tid()
    world = views[view]
    if world >= 0:
        transforms[view] = turn * poses[world]


@wp.kernel(enable_backward=False)
def name_segments(
    shape_index: wp.array3d[wp.uint32], names: wp.array[wp.uint8], shapes: int, out: wp.array3d[wp.uint8]
):
    """Shape indices to segment numbers; 0 where the ray met nothing. dim = (views, height, width)."""
    view, row, column = wp.tid()  # pyright: ignore
    index = shape_index[view, row, column]
    value = wp.uint8(0)
    if index < wp.uint32(shapes):
        value = names[int(index)]
    out[view, row, column] = value


@wp.kernel(enable_backward=False)
def scale_brightness(views: wp.array[int], brightness: wp.array[float], image: wp.array3d[wp.uint32]):
    """Multiplies red, green and blue by the world's brightness. dim = (views, height, width)."""
    view, row, column = wp.tid()  # pyright: ignore
    world = views[view]
    if world >= 0:
        packed = image[view, row, column]
        value = wp.uint32(0)
        for channel in range(3):
            shift = wp.uint32(8 * channel)
            level = float((packed >> shift) & wp.uint32(255)) * brightness[world]
            value = value | (wp.uint32(wp.min(level + 0.5, 255.0)) << shift)
        image[view, row, column] = value


@wp.kernel(enable_backward=False)
def move_goal_marker(goal: wp.array2d[float], shapes: wp.array[int], transforms: wp.array[wp.transformf]):
    """Puts each world's marker on its goal."""
    world = wp.tid()
    at = wp.vec3f(goal[world, 0], goal[world, 1], goal[world, 2])
    transforms[shapes[world]] = wp.transformf(at, wp.quat_identity(dtype=float))


# -- randomization ------------------------------------------------------------------------------------------


# A generator must be advanced where it lives: a function that took it would advance a copy, and every draw
# would be the same one.


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
    rng = episode_rng(seed[0], world, episode[world], 4)
    level[world] = 1.0 + wp.randf(rng, -brightness, brightness)
    e = (
        eye
        + wp.vec3f(wp.randf(rng, -1.0, 1.0), wp.randf(rng, -1.0, 1.0), wp.randf(rng, -1.0, 1.0)) * eye_noise
    )
    t = at + wp.vec3f(wp.randf(rng, -1.0, 1.0), wp.randf(rng, -1.0, 1.0), wp.randf(rng, -1.0, 1.0)) * at_noise
    back = wp.normalize(e - t)
    right = wp.normalize(wp.cross(wp.vec3f(0.0, 0.0, 1.0), back))
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
    rng = episode_rng(seed[0], world, episode[world], 5)
    for j in range(ke.shape[1]):
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


# -- reaching -----------------------------------------------------------------------------------------------


@wp.kernel(enable_backward=False)
def judge_reach(
    state: wp.array2d[float],
    action: wp.array2d[float],
    kind: int,
    penalty: float,
    success_distance: float,
    initial_distance: wp.array[float],
    reward: wp.array2d[float],
    success: wp.array2d[wp.bool],
):
    """Reward and success. ``kind``: 0 dense, 1 sparse, 2 normalized."""
    world = wp.tid()
    distance = wp.length(wp.vec3f(state[world, 17], state[world, 18], state[world, 19]))
    effort = float(0.0)
    for j in range(action.shape[1]):
        a = wp.clamp(action[world, j], -1.0, 1.0)
        if wp.isfinite(action[world, j]):
            effort += a * a
    solved = distance < success_distance
    value = -wp.tanh(distance)
    if kind == 1:
        value = wp.where(solved, 1.0, 0.0)
    if kind == 2:
        value = wp.max(1.0 - distance / wp.max(initial_distance[world], success_distance), -1.0)
    reward[world, 0] = value - penalty * effort / float(action.shape[1])
    success[world, 0] = solved


@wp.kernel(enable_backward=False)
def note_initial_distance(
    mask: wp.array[wp.bool], state: wp.array2d[float], initial_distance: wp.array[float]
):
    world = wp.tid()
    if mask[world]:
        initial_distance[world] = wp.length(wp.vec3f(state[world, 17], state[world, 18], state[world, 19]))


@wp.kernel(enable_backward=False)
def circle_goal(
    mask: wp.array[wp.bool],
    everywhere: bool,
    seed: wp.array[int],
    episode: wp.array[int],
    step_count: wp.array2d[int],
    phase: wp.array[float],
    ahead: int,
    dt: float,
    radius: float,
    period: float,
    center: wp.array2d[float],
    goal: wp.array2d[float],
):
    """The goal on an upright circle that faces the robot, at the time of ``step_count`` + ``ahead``."""
    world = wp.tid()
    if everywhere or mask[world]:
        if not everywhere:  # a new episode; kept, so that a state can be continued in another world
            rng = episode_rng(seed[0], world, episode[world], 6)
            phase[world] = wp.randf(rng, 0.0, 2.0 * wp.pi)
        angle = phase[world] + 2.0 * wp.pi * float(step_count[world, 0] + ahead) * dt / period
        goal[world, 0] = center[world, 0]
        goal[world, 1] = center[world, 1] + radius * wp.cos(angle)
        goal[world, 2] = wp.max(center[world, 2] + radius * wp.sin(angle), 0.05)


@wp.kernel(enable_backward=False)
def fixed_goal(
    mask: wp.array[wp.bool],
    fixed: wp.array[float],
    pose: wp.array[float],
    goal_q: wp.array2d[float],
    goal: wp.array2d[float],
):
    world = wp.tid()
    if mask[world]:
        for i in range(3):
            goal[world, i] = fixed[i]
        for j in range(JOINTS):
            goal_q[world, j] = pose[j]


@wp.kernel(enable_backward=False)
def reachable_goal(
    mask: wp.array[wp.bool],
    seed: wp.array[int],
    episode: wp.array[int],
    home: wp.array[float],
    noise: float,
    lower: wp.array[float],
    upper: wp.array[float],
    parent_frames: wp.array[wp.transformf],
    child_frames: wp.array[wp.transformf],
    axes: wp.array[wp.vec3f],
    tool_frame: wp.array[wp.transformf],
    goal_q: wp.array2d[float],
    goal: wp.array2d[float],
):
    """The tool position of a random pose around home; poses in the ground or in the base are drawn again."""
    world = wp.tid()
    if not mask[world]:
        return
    rng = episode_rng(seed[0], world, episode[world], 1)
    found = bool(False)
    for _attempt in range(32):
        if not found:
            for j in range(JOINTS):
                goal_q[world, j] = wp.clamp(home[j] + wp.randf(rng, -noise, noise), lower[j], upper[j])
            tool = chain_forward(goal_q, world, parent_frames, child_frames, axes, tool_frame)
            if tool[2] > 0.10 and wp.sqrt(tool[0] * tool[0] + tool[1] * tool[1]) > 0.25:
                for i in range(3):
                    goal[world, i] = tool[i]
                found = True
    if not found:  # one in 10^12 episodes at the default noise: the home pose is a goal, too
        for j in range(JOINTS):
            goal_q[world, j] = home[j]
        tool = chain_forward(goal_q, world, parent_frames, child_frames, axes, tool_frame)
        for i in range(3):
            goal[world, i] = tool[i]
