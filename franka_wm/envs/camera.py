# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
# pyright: reportCallIssue=false, reportReturnType=false, reportIndexIssue=false
# (Warp's and TorchRL's annotations know neither vectors nor shapes as tuples.)
"""Pixels of N worlds, and the framing that every renderer shares."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import newton
import numpy as np
import torch
import warp as wp
from newton.sensors import SensorCamera

from franka_wm.envs.config import FrankaConfig
from franka_wm.envs.kernels import rendering as kernels
from franka_wm.errors import UserError

if TYPE_CHECKING:
    from franka_wm.envs.kinematics import Kinematics
    from franka_wm.envs.scene import Scene
    from franka_wm.envs.simulation.arrays import Arrays
    from franka_wm.envs.simulation.build import Chain

BACKGROUND = (0.62, 0.71, 0.80)
GROUND = (0.34, 0.37, 0.41)
WRIST_FOV_DEGREES = 75.0
GOAL_MARKER = "goal-marker"
"""Label of a shape. No name of an object can be or end like it: they have no hyphen."""

MARKER, TABLE = 255, 254
"""Their numbers in `segmentation`; obstacles follow downwards."""

LINK = 0.06
"""Half the thickness of a link, or of the hand beside the tool [m]."""

TURNS = {"front": 0.0, "side": -math.pi / 2.0}
"""Where the fixed cameras stand: so far around the vertical axis through what they look at [rad]."""


def camera_framing(config: FrankaConfig) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """(eye, target) in world metres."""
    target = (config.camera_target_distance, 0.0, config.camera_target_height)
    return (config.camera_distance, 0.0, config.camera_height), target


def whole_arm(config: FrankaConfig, kinematics: Kinematics) -> FrankaConfig:
    """The configuration with its camera moved so that the arm stays in the image in every pose: for videos.

    So does what it can meet of a scene, see :meth:`~franka_wm.envs.scene.Scene.outline`. The direction is the same, the
    distance as small as possible, and each world's camera stands alike.
    """
    eye, target = (np.array(point) for point in camera_framing(config))
    back = (eye - target) / np.linalg.norm(eye - target)
    side = np.array([0.0, 1.0, 0.0])
    axes = np.stack([side, np.cross(back, side), back], 1)
    shares = torch.rand(4096, kinematics.lower.numel(), generator=torch.Generator().manual_seed(0))
    lower, upper = kinematics.lower.cpu(), kinematics.upper.cpu()
    tools = kinematics.forward((lower + shares * (upper - lower)).to(kinematics.lower.device)).cpu().numpy()
    tools = tools[tools[:, 2] > 0.0]  # above the ground
    scene, raised = config.resolved_scene, (0.0, 0.0, config.randomization.table_height)
    around = np.array(scene.outline() if scene else []).reshape(-1, 3)
    around = np.concatenate([around - raised, around + raised])
    slope = math.tan(0.5 * math.radians(config.camera_fov_degrees))

    def needed(points: np.ndarray, height: float) -> np.ndarray:
        """How far the camera must be to see each point, if it looks at this height."""
        seen = (points - (0.0, 0.0, height)) @ axes
        return (np.abs(seen[:, :2]).max(1) + LINK) / slope + seen[:, 2]

    def distance(height: float) -> float:
        arm = np.quantile(needed(tools, height), 0.97)  # the rest are stretched out to the limit
        return float(needed(around, height).max(initial=arm))

    height = min(np.linspace(0.0, tools[:, 2].max(), 33).tolist(), key=distance)
    eye = (0.0, 0.0, height) + distance(height) * back
    return replace(
        config,
        camera_distance=float(eye[0]),
        camera_height=float(eye[2]),
        camera_target_distance=0.0,
        camera_target_height=height,
        randomization=replace(config.randomization, camera_position=0.0, camera_target=0.0),
    )


def look_at(eye, target) -> wp.transformf:
    """Camera frame at ``eye`` looking along −Z at ``target``, +Y up, in a world whose z is up.

    Raises:
        UserError: If the points coincide.
    """
    eye, target = np.asarray(eye, dtype=np.float64), np.asarray(target, dtype=np.float64)
    back = eye - target
    length = np.linalg.norm(back)
    if length < 1e-9:
        raise UserError(f"camera eye and target coincide at {tuple(eye)}; move one of them")
    back /= length
    right = np.cross([0.0, 0.0, 1.0], back)
    if np.linalg.norm(right) < 1e-6:  # looking straight up or down
        right = np.array([0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    up = np.cross(back, right)
    rotation = wp.quat_from_matrix(wp.mat33f(*np.stack([right, up, back], axis=1).flatten().tolist()))
    return wp.transformf(wp.vec3f(*eye.tolist()), rotation)


def _pack(color) -> int:
    r, g, b = (round(255 * c) for c in color)
    return r | g << 8 | b << 16  # alpha is never read


class Camera:
    """One camera's view of each of N worlds, ray traced by Newton.

    Args:
        model: The Newton model.
        config: Framing, field of view, shadows.
        name: ``"front"`` or ``"side"``, which stand still, or ``"wrist"``, which rides on the hand.
        kinds: What it renders: any of ``"pixels"``, ``"depth"``, ``"segmentation"``.
        size: Side of the square image [px]; ``config.image_size`` if not given.
        num_views: How many worlds are seen at once.
        samples: Anti-aliasing factor: ``samples``² rays per pixel.

    Attributes:
        images: By kind, what :meth:`render` writes if nothing else is given; see :meth:`allocate`.
    """

    def __init__(
        self,
        model: newton.Model,
        config: FrankaConfig,
        *,
        name: str = "front",
        kinds: tuple[str, ...] = ("pixels",),
        size: int | None = None,
        num_views: int | None = None,
        samples: int = 1,
    ):
        size = config.image_size if size is None else size
        views = model.world_count if num_views is None else num_views
        self.name, self.kinds, self.size, self.num_views = name, kinds, size, views
        self._model, self._brightness = model, config.randomization.brightness > 0
        self._moves = name == "wrist" or bool(
            config.randomization.camera_position or config.randomization.camera_target
        )
        aa = SensorCamera.AntiAliasing
        self.sensor = SensorCamera(
            model,
            default_clear_data=SensorCamera.ClearData(clear_color=_pack(BACKGROUND)),
            default_render_config=SensorCamera.RenderConfig(
                enable_shadows=config.enable_shadows,
                enable_textures=config.enable_textures,
                render_order=SensorCamera.RenderOrder.TILED,
                tile_width=min(8, size),  # 8 × 16 and 128 threads: the fastest of 27 on an H200, by 12 %
                tile_height=min(16, size),
                block_dim=128,
                anti_aliasing=aa.MSAA if samples > 1 else aa.NONE,
            ),
            load_textures=config.enable_textures,
        )
        light = np.array([-0.55, 0.35, -0.75])
        self.sensor.create_default_light(
            enable_shadows=config.enable_shadows,
            direction=wp.vec3f(*(light / np.linalg.norm(light)).tolist()),
        )
        turn = wp.quat_from_axis_angle(wp.vec3f(0.0, 0.0, 1.0), TURNS.get(name, 0.0))
        axis = wp.vec3f(config.camera_target_distance, 0.0, 0.0)
        self._turn = wp.transformf(axis - wp.quat_rotate(turn, axis), turn)  # pyright: ignore[reportOperatorIssue]
        pose = self._turn * look_at(*camera_framing(config))  # pyright: ignore[reportOperatorIssue]
        self.transforms = wp.array([pose] * views, dtype=wp.transformf, device=model.device)
        self.views = wp.array(np.arange(views), dtype=int, device=model.device)
        self.rays = SensorCamera.compute_camera_rays_pinhole(
            size,
            size,
            camera_fov=math.radians(WRIST_FOV_DEGREES if name == "wrist" else config.camera_fov_degrees),
            sample_count=samples * samples,
            device=model.device,
        )
        if "segmentation" in kinds:
            self._shape_index = self.sensor.allocate_image_shape_index(views, size, size)
            self._segments = wp.array(
                segment_numbers(model, config.resolved_scene), dtype=wp.uint8, device=model.device
            )
        self.images = self.allocate(views)

    def allocate(self, views: int) -> dict[str, wp.array]:
        """Zeroed images by kind, (views, size, size): packed RGBA, metres, segment numbers."""
        types = {"pixels": wp.uint32, "depth": wp.float32, "segmentation": wp.uint8}
        return {
            kind: self.sensor.allocate_image(views, self.size, self.size, types[kind]) for kind in self.kinds
        }

    def render(
        self,
        state: newton.State,
        arrays: Arrays[wp.array],
        chain: Chain,
        *,
        images: dict[str, wp.array] | None = None,
    ) -> None:
        """Renders the worlds that ``self.views`` names; the others' images stay. Refit the shapes first.

        Args:
            state: Where everything is.
            arrays: The simulation's; read are ``poses`` and ``brightness``.
            chain: Where the wrist camera rides.
            images: Where to; ``self.images`` if not given.
        """
        images = self.images if images is None else images
        device, n, size = self._model.device, self.num_views, self.size
        if self.name == "wrist":
            bodies = self._model.body_count // self._model.world_count
            body_q = state.body_q.reshape((self._model.world_count, bodies))
            inputs = [body_q, chain.tool_body, chain.mount, self.views, self.transforms]
            wp.launch(kernels.aim_wrist, n, inputs, device=device)
        elif self._moves:
            inputs = [arrays.poses, self._turn, self.views, self.transforms]
            wp.launch(kernels.aim_fixed, n, inputs, device=device)
        self.sensor.update(
            state,
            self.transforms,
            self.rays,
            color_image=images.get("pixels"),
            depth_image=images.get("depth"),
            shape_index_image=self._shape_index if "segmentation" in self.kinds else None,
            world_indices=self.views,
        )
        if "segmentation" in self.kinds:
            inputs = [self._shape_index, self._segments, self._segments.shape[0], images["segmentation"]]
            wp.launch(kernels.name_segments, (n, size, size), inputs, device=device)
        if self._brightness and "pixels" in images:
            inputs = [self.views, arrays.brightness, images["pixels"]]
            wp.launch(kernels.scale_brightness, (n, size, size), inputs, device=device)


def as_torch(kind: str, image: wp.array) -> torch.Tensor:
    """The same memory as a torch tensor: (views, H, W, 3) uint8, or (views, H, W, 1) float32 [m] or uint8."""
    tensor = wp.to_torch(image)
    if kind == "pixels":
        return tensor.view(torch.uint8).view(*image.shape, 4)[..., :3]
    return tensor.unsqueeze(-1)


def segment_numbers(model: newton.Model, scene: Scene | None) -> np.ndarray:
    """For each shape: 1 for the ground, 2 for the robot's base, 3 … for its moving links in order, then (from 12 on)
    the scene's objects, then case and moving part of each drawer or door; 255 for the goal marker, 254 for the table,
    253, 252, … for the scene's obstacles. 0 is left for rays that meet nothing."""
    bodies = model.shape_body.numpy()
    worlds = model.shape_world.numpy()
    per_world = model.body_count // model.world_count
    numbers = np.where(bodies >= 0, 3 + bodies % per_world, np.where(worlds >= 0, 2, 1))
    numbers[[label.endswith(GOAL_MARKER) for label in model.shape_label]] = MARKER
    still = [one.name for one in (scene.table, *scene.obstacles)] if scene else []
    for k, name in enumerate(still):
        there = [label == name for label in model.shape_label]
        numbers[np.array(there) & (bodies < 0) & (worlds >= 0)] = TABLE - k
    return numbers.astype(np.uint8)


def wrist_mount(tool_frame: np.ndarray) -> wp.transformf:
    """The wrist camera in the frame of the link that carries the tool: 7 cm before the palm, looking along the
    fingers."""
    # The tool's z points out of the hand; a camera looks along −z: half a turn about x. Above it, the fingers.
    flip = wp.transformf(
        wp.vec3f(0.075, 0.0, -0.11), wp.quat_from_axis_angle(wp.vec3f(1.0, 0.0, 0.0), math.pi)
    )
    return wp.transformf(*np.asarray(tool_frame, dtype=np.float32).tolist()) * flip  # pyright: ignore[reportOperatorIssue]


SKIP_VIEW = int(SensorCamera.WorldRenderFlag.DISABLE_PRESERVE)
"""World index of a view that is not rendered: its pixels stay as they are."""


def project(points: torch.Tensor, config: FrankaConfig, size: int) -> torch.Tensor:
    """Where world points are seen: (..., 3) [m] → (..., 2) pixel columns and rows of a ``size``² image."""
    pose = look_at(*camera_framing(config))
    rotation = torch.tensor(
        np.array(wp.quat_to_matrix(pose.q)).reshape(3, 3), dtype=points.dtype, device=points.device
    )
    eye = torch.tensor(list(pose.p), dtype=points.dtype, device=points.device)
    x, y, z = ((points - eye) @ rotation).unbind(-1)
    focal = 0.5 * size / math.tan(0.5 * math.radians(config.camera_fov_degrees))
    return torch.stack([0.5 * size + focal * x / -z, 0.5 * size - focal * y / -z], -1)
