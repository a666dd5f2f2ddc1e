# pyright: reportArgumentType=false, reportCallIssue=false
# (Warp's annotations know neither vectors nor shapes as tuples.)
"""The images of all worlds: of the present, of the last step's end, of the goal."""

from __future__ import annotations

from typing import TYPE_CHECKING

import newton
import torch
import warp as wp

from franka_wm.envs.camera import GOAL_MARKER, SKIP_VIEW, Camera, as_torch
from franka_wm.envs.kernels import goals
from franka_wm.envs.kernels import rendering as kernels

if TYPE_CHECKING:
    from franka_wm.envs.simulation.simulator import Simulation


class Renderer:
    """Cameras and what they show; nothing at all if the config asks for no images.

    Worlds that were reset are rendered a second time, few at once: a pass over all views, most of them
    skipped, costs a tenth of a full one on a GPU.

    Args:
        sim: The simulation, its arrays allocated.

    Attributes:
        images, next_images: By observation key (``pixels``, ``depth_wrist``, …): torch tensors of the present, and of
            what the last step led to before any reset. (N, H, W, 3 or 1).
        cameras: For each camera: all views at once, few views, images of the present, images of the step's end.
    """

    def __init__(self, sim: Simulation):
        self.sim = sim
        cfg, n, model = sim.config, sim.num_envs, sim.model
        self.images: dict[str, torch.Tensor] = {}
        self.next_images: dict[str, torch.Tensor] = {}
        self.cameras: list[tuple[Camera, Camera, dict[str, wp.array], dict[str, wp.array]]] = []
        kinds = tuple(k for k in cfg.images if k != "goal_pixels")
        some = max(1, n // 16)
        for name in cfg.cameras if kinds else ():
            suffix = "" if name == cfg.cameras[0] else f"_{name}"
            full = Camera(model, cfg, name=name, kinds=kinds)
            few = Camera(model, cfg, name=name, kinds=kinds, num_views=some)
            after = full.allocate(n)
            self.cameras.append((full, few, full.images, after))
            for kind in kinds:
                self.images[kind + suffix] = as_torch(kind, full.images[kind])
                self.next_images[kind + suffix] = as_torch(kind, after[kind])
        self._goal_cameras: list[tuple[Camera, wp.array, wp.array]] = []
        if "goal_pixels" in cfg.images:
            for name in cfg.cameras:
                camera = Camera(model, cfg, name=name, num_views=some)
                now, after = (camera.allocate(n)["pixels"] for _ in range(2))
                self._goal_cameras.append((camera, now, after))
                key = "goal_pixels" if name == cfg.cameras[0] else f"goal_pixels_{name}"
                self.images[key], self.next_images[key] = as_torch("pixels", now), as_torch("pixels", after)
            self._goal_state = model.state()
            self._no_speed = wp.zeros_like(sim.newton_state.joint_qd)
            coordinates = model.joint_coord_count // n
            self._goal_joints = wp.zeros((n, coordinates), dtype=float, device=sim.device)
        self._views = wp.zeros(some, dtype=int, device=sim.device)
        self._worlds = wp.zeros(n, dtype=int, device=sim.device)
        self._counts = wp.zeros(3, dtype=int, device=sim.device)
        if cfg.show_goal:
            labels = enumerate(model.shape_label)
            markers = [i for i, label in labels if label.endswith(GOAL_MARKER)]
            self._markers = wp.array(markers, dtype=int, device=sim.device)

    def arrays(self) -> list[wp.array]:
        """Every image."""
        out = [image for _, _, now, after in self.cameras for image in (*now.values(), *after.values())]
        return out + [image for _, now, after in self._goal_cameras for image in (now, after)]

    def launch_step(self) -> None:
        """Renders what a step led to, of all worlds; frames of broken worlds are those of their last finite pose."""
        sim = self.sim
        if self.cameras:
            # A broken world is shown in its last finite pose; its NaN must not reach the ray tracer's tree.
            sim.launch_forward_kinematics(sim.warp.broken)
            self.launch_marker()
            sim.model.bvh_refit_shapes(sim.newton_state)
            for camera, _, now, after in self.cameras:
                camera.render(sim.newton_state, sim.warp, sim.chain, images=after)
                for kind, image in after.items():
                    wp.copy(now[kind], image)
        for _, now, after in self._goal_cameras:
            wp.copy(after, now)

    def launch_reset(self) -> None:
        """Renders the present of the worlds that were reset."""
        if not (self.cameras or self._goal_cameras):
            return
        self.launch_marker()
        self._list_worlds(self.sim.warp.mask)
        self._pose_at_goal()
        wp.capture_while(self._counts[2:], self._render_some)

    def show_all(self) -> None:
        """Renders the present of all worlds anew, at once, on torch's stream."""
        sim = self.sim
        with sim.recorder.on_stream_of_torch():
            self.launch_marker()
            self._pose_at_goal()
            self._list_worlds(wp.ones(sim.num_envs, dtype=wp.bool, device=sim.device))
            for _ in range(-(-sim.num_envs // self._views.shape[0])):
                self._render_some()

    def show_goal(self) -> None:
        """Renders anew what shows a goal that was moved by hand."""
        if self._goal_cameras or (self.cameras and self.sim.config.show_goal):
            self.show_all()

    def launch_marker(self) -> None:
        """Puts the markers of ``show_goal`` on the present goals: before whatever renders them."""
        sim = self.sim
        if sim.config.show_goal:
            scene = sim.config.resolved_scene
            ground, flat = (scene.top if scene else 0.0), type(sim.task).marker is not None
            w = sim.warp
            inputs = [w.task_goal, flat, ground, w.raised, self._markers, sim.model.shape_transform]
            wp.launch(kernels.move_goal_marker, sim.num_envs, inputs, device=sim.device)

    def _list_worlds(self, mask: wp.array) -> None:
        self._counts.zero_()
        inputs = [mask, self._worlds, self._counts]
        wp.launch(kernels.list_worlds, self.sim.num_envs, inputs, device=self.sim.device)

    def _pose_at_goal(self) -> None:
        if self._goal_cameras:
            sim, w = self.sim, self.sim.warp
            inputs = [w.goal_q, w.goal_rest, self._goal_joints]
            wp.launch(goals.join_goal, sim.num_envs, inputs, device=sim.device)
            newton.eval_fk(sim.model, self._goal_joints.flatten(), self._no_speed, self._goal_state)

    def _render_some(self) -> None:
        """Renders the next few of the listed worlds into their images."""
        sim, views, some = self.sim, self._views, self._views.shape[0]
        inputs = [self._worlds, self._counts, SKIP_VIEW, views]
        wp.launch(kernels.choose_views, some, inputs, device=sim.device)
        if self._goal_cameras:
            sim.model.bvh_refit_shapes(self._goal_state)
            for camera, now, _ in self._goal_cameras:
                self._render_into(camera, self._goal_state, {"pixels": now})
        sim.model.bvh_refit_shapes(sim.newton_state)
        for _, few, now, _ in self.cameras:
            self._render_into(few, sim.newton_state, now)
        wp.launch(kernels.advance_views, 1, [some, self._counts, self._counts[2:]], device=sim.device)

    def _render_into(self, camera: Camera, state: newton.State, images: dict[str, wp.array]) -> None:
        wp.copy(camera.views, self._views)
        camera.render(state, self.sim.warp, self.sim.chain)
        shape = (camera.num_views, camera.size, camera.size)
        for kind, image in images.items():
            inputs = [camera.views, camera.images[kind], image]
            wp.launch(kernels.PLACE[kind], shape, inputs, device=self.sim.device)
