"""The arm, its goal and its paths as a viser scene."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from franka_wm.live.session import GOAL_NAME
from franka_wm.live.shapes import Shape, wxyz

if TYPE_CHECKING:
    import viser

    from franka_wm.live.frame import Frame

EYE, LOOK_AT = (1.42, 1.00, 0.90), (0.12, 0.13, 0.40)
"""Where the page's camera starts [m]: the whole arm and its reach, seen from its left front."""
FIELD_OF_VIEW = np.deg2rad(45.0)
"""From the lower to the upper edge."""
PORTRAIT = 0.75
"""Width by height below which a window is a phone's: its controls cover the lower 60 %."""

SKY, GROUND, CELL, SECTION = (236, 240, 245), (206, 211, 218), (186, 192, 201), (160, 167, 177)
GOAL, REACHED, PATH, TRAIL = (213, 94, 0), (0, 158, 115), (0, 114, 178), (150, 156, 166)
CONTACT = (204, 0, 119)
TRAIL_STEPS = 60
METRES_PER_NEWTON, LONGEST_FORCE = 0.01, 0.2
"""Length of the line that stands for a force, to each side of its point [m/N], and its most [m]. On both sides, or what
touches would hide it."""
DARKEST = 44
"""Least red, green and blue of a shape: in black, shading shows no form."""


class ViserScene:
    """What a :class:`~franka_wm.live.frame.Frame` looks like.

    Args:
        server: Where to draw.
        shapes: The arm's, by :func:`~franka_wm.live.shapes.arm_shapes`.
        bodies: Number of moving links.
        success_distance: Radius of the goal's outer sphere [m]; ``None``: success is no distance, and there is none.
        floor: Height of the ground [m].
        on_goal: Called with (x, y, z) [m] while the goal is dragged in a browser; must return at once.
        objects: Name → row of the body poses of what can be dragged as well.
        on_object: Called with a name and (x, y, z) [m] while an object is dragged; must return at once.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        shapes: Sequence[Shape],
        *,
        bodies: int,
        success_distance: float | None,
        floor: float = 0.0,
        on_goal: Callable[[tuple[float, float, float]], None],
        objects: Mapping[str, int] = MappingProxyType({}),
        on_object: Callable[[str, tuple[float, float, float]], None] = lambda name, point: None,
    ):
        self._server, self._on_goal, self._on_object = server, on_goal, on_object
        self._dragged: set[str] = set()
        self._trail: deque[np.ndarray] = deque(maxlen=TRAIL_STEPS)
        self._lines: dict[str, Any] = {}
        self._touching: list[Any] = []
        self._reached: bool | None = None
        self._stage(floor)
        self.links = [server.scene.add_frame(f"/arm/link{i + 1}", show_axes=False) for i in range(bodies)]
        for shape in shapes:
            parent = "/arm/base" if shape.body < 0 else f"/arm/link{shape.body + 1}"
            server.scene.add_mesh_simple(
                f"{parent}/{shape.name}",
                shape.vertices,
                shape.faces,
                color=_lit(shape.colour),
                position=shape.position,
                wxyz=shape.wxyz,
            )
        self.goal = server.scene.add_transform_controls(
            GOAL_NAME, scale=0.16, line_width=3.0, disable_rotations=True, depth_test=False
        )
        self._ball = server.scene.add_icosphere("/goal/ball", radius=0.018, color=GOAL, subdivisions=4)
        self._halo = server.scene.add_icosphere(
            "/goal/success",
            radius=success_distance or 0.05,
            color=GOAL,
            opacity=0.16,
            subdivisions=4,
            cast_shadow=False,
            receive_shadow=False,
            visible=success_distance is not None,
        )
        self.goal.on_update(self._drag)
        self.objects = {}
        for name, row in objects.items():
            self.objects[row] = handle = server.scene.add_transform_controls(
                handle_name(name), scale=0.09, line_width=2.0, disable_rotations=True, depth_test=False
            )
            handle.on_update(self._drag)
        server.on_client_connect(_aim)

    def _stage(self, floor: float) -> None:
        scene = self._server.scene
        scene.set_up_direction("+z")
        scene.world_axes.visible = False
        scene.set_background_image(np.full((2, 2, 3), SKY, dtype=np.uint8))
        scene.configure_default_lights(enabled=False)
        scene.configure_environment_map(hdri=None)
        scene.add_light_hemisphere(
            "/light/sky", sky_color=(255, 255, 255), ground_color=(176, 182, 194), intensity=1.9
        )
        scene.add_light_directional(
            "/light/key", position=(1.2, 1.6, 2.6), intensity=2.2, color=(255, 248, 238), cast_shadow=True
        )
        scene.add_light_directional(
            "/light/rim", position=(-1.5, -2.0, 1.5), intensity=0.8, color=(214, 228, 255)
        )
        scene.add_grid(
            "/ground",
            position=(0.0, 0.0, floor),
            width=4.0,
            height=4.0,
            cell_size=0.1,
            section_size=0.5,
            cell_color=CELL,
            section_color=SECTION,
            plane_color=GROUND,
            plane_opacity=1.0,
            shadow_opacity=0.3,
        )
        camera = self._server.initial_camera
        camera.position, camera.look_at, camera.fov = EYE, LOOK_AT, float(FIELD_OF_VIEW)

    def show(self, frame: Frame) -> None:
        """Moves everything to where the frame has it."""
        with self._server.atomic():
            for link, pose in zip(self.links, frame.bodies, strict=True):
                link.position, link.wxyz = pose[:3], wxyz(pose[3:])
            # What is dragged is where the hand has it, not where it was a step ago.
            if GOAL_NAME not in self._dragged:
                self.goal.position = frame.goal
            for row, handle in self.objects.items():
                if handle.name not in self._dragged:
                    handle.position = frame.bodies[row, :3]
            if frame.success is not self._reached:
                self._reached = frame.success
                self._ball.color = self._halo.color = REACHED if frame.success else GOAL
            self._draw_paths(frame)
            self._draw_contacts(frame.contacts)

    def _draw_paths(self, frame: Frame) -> None:
        if not frame.stepped and self._trail and np.linalg.norm(self._trail[-1] - frame.tool) > 1e-4:
            self._trail.clear()  # set elsewhere by hand
        if self._trail and np.linalg.norm(self._trail[-1] - frame.tool) > 0.3:
            self._trail.clear()  # another episode
        if frame.stepped:
            self._trail.append(frame.tool)
        trail = np.array(self._trail) if len(self._trail) > 1 else None
        self._line("/trail", trail, TRAIL, thickness=0.003)
        self._line("/plan", frame.path, PATH, thickness=0.007)

    def _line(
        self, name: str, points: np.ndarray | None, colour: tuple[int, int, int], *, thickness: float
    ) -> None:
        """A line through points (n, 3), or none."""
        handle = self._lines.get(name)
        if points is None or len(points) < 2:
            if handle is not None:
                handle.visible = False
            return
        segments = np.stack([points[:-1], points[1:]], 1).astype(np.float32)
        if handle is not None and len(handle.points) == len(segments):
            handle.points, handle.visible = segments, True
            return
        # Another number of points: viser replaces the node of this name.
        self._lines[name] = self._server.scene.add_line_segments(name, segments, colour, thickness=thickness)

    def _draw_contacts(self, contacts: np.ndarray | None) -> None:
        """Points, and a line along each force: (C, 7), or none."""
        if contacts is None or not len(contacts):
            old, self._touching = self._touching, []
            for handle in old:
                handle.remove()
            return
        points, normals, forces = contacts[:, :3], contacts[:, 3:6], contacts[:, 6:]
        reach = normals * np.clip(forces * METRES_PER_NEWTON, 0.0, LONGEST_FORCE)
        segments = np.stack([points - reach, points + reach], 1).astype(np.float32)
        colours = np.broadcast_to(np.array(CONTACT, dtype=np.uint8), points.shape)
        scene = self._server.scene  # another number of points: viser replaces the nodes of these names
        self._touching = [
            scene.add_point_cloud(
                "/contacts/points", points.astype(np.float32), colours, point_size=0.008, point_shape="circle"
            ),
            scene.add_line_segments("/contacts/forces", segments, CONTACT, thickness=0.004),
        ]

    async def _drag(self, event: Any) -> None:  # async: viser then keeps the order of start, updates and end
        name = event.target.name
        x, y, z = (float(v) for v in event.target.position)
        if name == GOAL_NAME:
            self._on_goal((x, y, max(z, 0.02)))
        else:
            self._on_object(name.removeprefix(handle_name("")), (x, y, z))
        if event.phase == "end":
            self._dragged.discard(name)
        else:
            self._dragged.add(name)


def handle_name(name: str) -> str:
    """Name of the handle that drags an object."""
    return f"/objects/{name}"


async def _aim(client: viser.ClientHandle) -> None:
    """Moves the camera of a phone held upright, so that the arm is above the controls; back when it is turned.

    A browser's first message may be of a picture that has not its size yet, so later ones are looked at, too. And a
    slow one takes the page's first view after it was told to move, as "Reset View" does later: it is told again.
    """
    upright = False

    async def look(camera: viser.CameraHandle) -> None:  # async: viser then keeps the order of messages
        nonlocal upright
        if not camera.image_width or not camera.image_height:
            return
        before, upright = upright, camera.aspect < PORTRAIT
        as_opened = np.allclose(camera.position, EYE, atol=1e-3) and np.allclose(
            camera.look_at, LOOK_AT, atol=1e-3
        )
        if upright is before and not (upright and as_opened):
            return
        eye, look_at = portrait_view(camera.aspect) if upright else (EYE, LOOK_AT)
        with client.atomic():
            camera.position = eye  # moves look_at along
            camera.look_at = look_at

    client.camera.on_update(look)


def portrait_view(aspect: float) -> tuple[np.ndarray, np.ndarray]:
    """(eye, look_at) [m] for a window higher than wide: what a wide one shows, in the upper 40 %.

    Args:
        aspect: Width by height.
    """
    eye, look_at, slope = np.array(EYE), np.array(LOOK_AT), np.tan(FIELD_OF_VIEW / 2)
    away = eye - look_at
    distance = float(np.linalg.norm(away))
    away /= distance
    up = np.cross(away, np.cross((0.0, 0.0, 1.0), away))
    farther = distance / min(aspect, 0.4)
    down = (
        0.45 * farther * slope * up / np.linalg.norm(up)
    )  # higher would cut a raised arm: it is nearer above
    return look_at + farther * away - down, look_at - down


def _lit(colour: tuple[int, int, int]) -> tuple[int, int, int]:
    red, green, blue = (max(c, DARKEST) for c in colour)
    return red, green, blue
