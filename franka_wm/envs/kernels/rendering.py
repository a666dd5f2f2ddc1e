# pyright: reportIndexIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false, reportAssignmentType=false, reportReturnType=false
# (Kernels are Warp's language: pyright knows neither its arrays nor its vectors.)
"""Which worlds are rendered, where cameras are, and where images go."""

# Warp reads annotations as types: no `from __future__ import annotations` here.
import warp as wp


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
    """Copies each view to its world's image. dim = (views, height, width)."""
    view, row, column = wp.tid()  # pyright: ignore
    world = views[view]
    if world >= 0:
        image[world, row, column] = rendered[view, row, column]


@wp.kernel(enable_backward=False)
def place_depth(views: wp.array[int], rendered: wp.array3d[wp.float32], image: wp.array3d[wp.float32]):
    """Copies each view to its world's image. dim = (views, height, width)."""
    view, row, column = wp.tid()  # pyright: ignore
    world = views[view]
    if world >= 0:
        image[world, row, column] = rendered[view, row, column]


@wp.kernel(enable_backward=False)
def place_segmentation(views: wp.array[int], rendered: wp.array3d[wp.uint8], image: wp.array3d[wp.uint8]):
    """Copies each view to its world's image. dim = (views, height, width)."""
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
def move_goal_marker(
    goal: wp.array2d[float],
    flat: bool,
    ground: float,
    raised: wp.array[float],
    shapes: wp.array[int],
    transforms: wp.array[wp.transformf],
):
    """Puts each world's marker on its goal, or, a ``flat`` one, on the ground below it."""
    world = wp.tid()
    at = wp.vec3f(goal[world, 0], goal[world, 1], wp.where(flat, ground + raised[world], goal[world, 2]))
    transforms[shapes[world]] = wp.transformf(at, wp.quat_identity(dtype=float))
