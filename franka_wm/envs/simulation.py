# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
# pyright: reportCallIssue=false, reportReturnType=false, reportIndexIssue=false
# (Warp's and TorchRL's annotations know neither vectors nor shapes as tuples.)
"""N worlds in Newton: build, step, masked reset, state views; the one captured graph.

Everything that a step reads or writes is a fixed array, shared between torch and Warp without copies. A step
is one graph launch, on CUDA and on the CPU:

    actions → servo targets → physics → observation → task → ends of episodes → pictures
            → masked reset → observation → pictures of the worlds that were reset

Without the second line, for who resets finished worlds by himself, it is another graph.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace

import newton
import torch
import warp as wp

from franka_wm.envs import kernels
from franka_wm.envs.camera import (
    GOAL_MARKER,
    GROUND,
    SKIP_VIEW,
    Camera,
    as_torch,
    camera_framing,
    look_at,
    wrist_mount,
)
from franka_wm.envs.config import HOME, NUM_JOINTS, STATE_DIM, FrankaConfig
from franka_wm.envs.kinematics import Kinematics
from franka_wm.envs.randomize import Randomizer
from franka_wm.envs.robots import Robot, add_robot
from franka_wm.envs.tasks import Task, make_task
from franka_wm.errors import UserError

STATISTICS = ("episodes", "return", "length", "success", "success_once", "nonfinite")
"""Columns of :attr:`Simulation.statistics`; all but the first and last are sums over finished episodes."""


def build_model(
    config: FrankaConfig, num_envs: int, device: str, urdf_path: str | Path | None = None
) -> tuple[newton.Model, Robot]:
    """N copies of the robot, and the ground that all of them share."""
    arm = newton.ModelBuilder()
    newton.solvers.SolverMuJoCo.register_custom_attributes(arm)
    robot = add_robot(arm, config, urdf_path)
    scene = newton.ModelBuilder()
    newton.solvers.SolverMuJoCo.register_custom_attributes(scene)
    if config.show_goal:
        ghost = newton.ModelBuilder.ShapeConfig(
            has_shape_collision=False, has_particle_collision=False, density=0.0
        )
        arm.add_shape_sphere(body=-1, radius=0.025, cfg=ghost, color=(0.90, 0.22, 0.12), label=GOAL_MARKER)
    if torch.device(device).type == "cuda":
        # Warp's default there builds trees fast and traces them slowly; a robot's are built once.
        scene.default_bvh_cfg.mesh_constructor = "cubql"
    scene.replicate(arm, num_envs)
    ground = newton.ModelBuilder.ShapeConfig(has_shape_collision=False, has_particle_collision=False)
    scene.add_ground_plane(cfg=ground, color=GROUND)
    return scene.finalize(device=device), robot


class Simulation:
    """N simulated arms. Knows nothing of TorchRL.

    Args:
        config: The arm and its task.
        num_envs: Number of worlds, N.
        device: ``"cpu"`` or ``"cuda:k"``.
        seed: Decides, with world and episode number, all randomness.
        urdf_path: Overrides the robot that the config names.
        task: What is asked of the arm; the config's if not given.

    Attributes (torch tensors; the next launch overwrites them, so clone what is kept):
        action: (N, A), written by the caller before :meth:`step`.
        state, joint_target, goal: The present observation, (N, 20), (N, 7), (N, 3).
        next_state, next_joint_target, next_goal: The observation that the last step led to, before any reset.
        reward, success, terminated, truncated, done: Of the last step, (N, 1).
        images, next_images: By observation key (``pixels``, ``depth_wrist``, …), if the config asks for pictures.
        statistics: (N, 6) float64, see :data:`STATISTICS`.
    """

    def __init__(
        self,
        config: FrankaConfig,
        num_envs: int,
        device: str,
        *,
        seed: int = 0,
        urdf_path: str | Path | None = None,
        task: Task | None = None,
    ):
        self.config = config
        self.num_envs = num_envs
        self.device = device
        self.model, self.robot = build_model(config, num_envs, device, urdf_path)
        self.solver, self._in_place = self._make_solver()
        self.newton_state = self.model.state()
        self._spare_state = None if self._in_place else self.model.state()
        self.control = self.model.control()
        self.kinematics = Kinematics(self.robot, device)
        self.task = make_task(config) if task is None else task
        self._allocate(seed)
        self.randomizer = Randomizer(self)
        self._allocate_images()
        self._dt = 1.0 / (config.fps * config.substeps)
        newton.eval_fk(self.model, self.model.joint_q, self.model.joint_qd, self.newton_state)
        self._step_graphs: dict[bool, wp.Graph] = {}
        self._reset_graph: wp.Graph | None = None

    # -- what a user of this class calls ------------------------------------------------------------------

    def step(self, *, restart: bool = True) -> None:
        """One control step of all worlds with :attr:`action`; one graph launch, no host sync.

        Args:
            restart: Whether finished worlds begin their next episode at once. Where they do not, they stay
                :attr:`done` until :meth:`reset` begins it.
        """
        if restart not in self._step_graphs:
            self._step_graphs[restart] = self._capture(
                self._launch_step_and_restart if restart else self._launch_step
            )
        self._replay(self._step_graphs[restart])

    def reset(self, mask: torch.Tensor | None = None) -> None:
        """Starts the next episode where ``mask`` (N,) is true, or everywhere; other worlds are untouched."""
        if mask is None:
            self._reset_mask[: self.num_envs] = True
        else:
            self._reset_mask[: self.num_envs] = mask.reshape(self.num_envs)
        if self._reset_graph is None:
            self._reset_graph = self._capture(self._launch_reset_and_observe)
        self._replay(self._reset_graph)

    def set_seed(self, seed: int) -> None:
        """The next reset of each world is its episode 0 of this seed."""
        self._seed.fill_(_as_int32(seed))
        self._episode.fill_(-1)

    def _memory(self) -> dict[str, torch.Tensor]:
        """Everything that the future depends on, by name, each (N, …); the same memory."""
        n, w = self.num_envs, self.warp
        names = (
            "step_count", "episode_return", "episode_success", "episode", "task_goal", "goal_center", "goal_q",
            "initial_distance", "phase", "target", "history", "delay", "brightness", "joint_q", "joint_qd", "control",
            "body_q", "poses",
        )  # fmt: skip
        out = {name: wp.to_torch(getattr(w, name)) for name in names}
        out["body_qd"] = wp.to_torch(self.newton_state.body_qd).view(n, -1, 6)
        out |= {
            f"solver_{name}": wp.to_torch(array)
            for name, array in self._solver_memory().items()
            if array.size
        }
        out |= {f"random_{k}": wp.to_torch(array) for k, array in enumerate(self.randomizer.arrays())}
        return out

    def get_state(self) -> dict[str, torch.Tensor]:
        """A copy of everything that the worlds' futures depend on, by name, each (N, …)."""
        state = {name: tensor.clone() for name, tensor in self._memory().items()}
        state["seed"] = self._seed.expand(self.num_envs).clone()
        return state

    def set_state(self, state: Mapping[str, torch.Tensor]) -> None:
        """Puts all worlds where :meth:`get_state` found them; its arrays have N rows.

        Raises:
            UserError: An array is missing or has another shape; nothing is changed then.
        """
        memory = self._memory()
        expected = memory | {"seed": self._seed.expand(self.num_envs)}
        for name, tensor in expected.items():
            if name not in state or state[name].shape != tensor.shape or state[name].dtype != tensor.dtype:
                found = f"{tuple(state[name].shape)} {state[name].dtype}" if name in state else "nothing"
                raise UserError(
                    f"set_state: {name} must be {tuple(tensor.shape)} {tensor.dtype}, is {found}; "
                    "take it from get_state() of an environment with the same config, with one row for each world"
                )
        for name, tensor in memory.items():
            tensor.copy_(state[name])
        self._seed.copy_(state["seed"][:1])
        self.randomizer.apply()
        self._observe_anew()
        if self._cameras or self._goal_cameras:
            self.show_all()

    def set_goal(self, goal: torch.Tensor) -> None:
        """Moves every world's goal to ``goal`` (N, 3) [m], until its next reset; no host sync.

        A goal that moves goes on from there: its circle is moved along.
        """
        self._goal_center += goal - self._task_goal
        self._task_goal.copy_(goal)
        self.goal_q.copy_(self.kinematics.solve(goal, self.goal_q, iterations=24))
        self._observe_anew()
        if self._goal_cameras or (self._cameras and self.config.show_goal):
            self.show_all()

    def _observe_anew(self) -> None:
        """The present observation after the arrays behind it were written by hand; resets no world."""
        self._reset_mask.zero_()
        if self._reset_graph is None:
            self._reset_graph = self._capture(self._launch_reset_and_observe)
        self._replay(self._reset_graph)

    def show_all(self) -> None:
        """Renders the present of all worlds anew."""
        device = wp.get_device(self.device)
        stream = wp.stream_from_torch(torch.cuda.current_stream(self.device)) if device.is_cuda else None
        with wp.ScopedStream(stream) if stream is not None else wp.ScopedDevice(device):
            self._launch_marker()
            if self._goal_cameras:
                newton.eval_fk(self.model, self.warp.goal_q.flatten(), self._no_speed, self._goal_state)
            self._counts.zero_()
            everywhere = wp.ones(self.num_envs, dtype=wp.bool, device=self.device)
            inputs = [everywhere, self._reset_worlds, self._counts]
            wp.launch(kernels.list_worlds, self.num_envs, inputs, device=self.device)
            for _ in range(-(-self.num_envs // self._views.shape[0])):
                self._render_some()

    # -- construction -------------------------------------------------------------------------------------

    def _make_solver(self):
        if self.config.solver == "featherstone":
            return newton.solvers.SolverFeatherstone(self.model), False
        solver = newton.solvers.SolverMuJoCo(
            self.model,
            iterations=self.config.solver_iterations,
            ls_iterations=self.config.solver_ls_iterations,
            disable_contacts=True,
            disable_sensors=True,
        )
        return solver, True

    def _lead(self) -> list[float]:
        """How far the set point may be ahead of each joint [rad]; without a speed limit, as far as it likes."""
        if not self.config.limit_velocity:
            return [1e6] * NUM_JOINTS
        ke, kd = self.config.gains("target_ke"), self.config.gains("target_kd")
        return [d * float(v) / k for k, d, v in zip(ke, kd, self.robot.velocity_limit, strict=True)]

    def _allocate(self, seed: int) -> None:
        n, device = self.num_envs, self.device

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
            return torch.zeros(shape, dtype=dtype, device=device)

        actions = self.config.action_dim
        self.action = zeros(n, actions)
        self._applied = zeros(n, actions)
        self._history = zeros(n, self.config.randomization.action_latency + 1, actions)
        self._delay = zeros(n, dtype=torch.int32)
        self._brightness = torch.ones(n, device=device)
        self.true_state = zeros(n, STATE_DIM)
        self.next_true_state = zeros(n, STATE_DIM)
        self.state, self.next_state = zeros(n, STATE_DIM), zeros(n, STATE_DIM)
        self.joint_target, self.next_joint_target = zeros(n, NUM_JOINTS), zeros(n, NUM_JOINTS)
        self.goal, self.next_goal = zeros(n, 3), zeros(n, 3)
        self.reward = zeros(n, 1)
        self.success, self.terminated = zeros(n, 1, dtype=torch.bool), zeros(n, 1, dtype=torch.bool)
        self.truncated, self.done = zeros(n, 1, dtype=torch.bool), zeros(n, 1, dtype=torch.bool)
        self.step_count = zeros(n, 1, dtype=torch.int32)
        self.episode_return = zeros(n, 1)
        self.episode_success = zeros(n, 1, dtype=torch.bool)
        self.statistics = zeros(n, len(STATISTICS), dtype=torch.float64)
        self._task_goal, self._target = zeros(n, 3), zeros(n, NUM_JOINTS)
        self._broken = zeros(n, dtype=torch.bool)
        self._reset_mask = zeros(
            n + 1, dtype=torch.bool
        )  # the last entry is Newton's global world: never reset
        self._seed = torch.full((1,), _as_int32(seed), dtype=torch.int32, device=device)
        self._episode = torch.full((n,), -1, dtype=torch.int32, device=device)
        self.goal_q = zeros(n, NUM_JOINTS)
        self.initial_distance = torch.ones(n, device=device)
        self._goal_center = zeros(n, 3)
        self._phase = zeros(n)

        shared = {
            name.lstrip("_"): wp.from_torch(tensor)
            for name, tensor in vars(self).items()
            if isinstance(tensor, torch.Tensor)
        }
        s, c, robot = self.newton_state, self.control, self.robot
        frames = dict(dtype=wp.transformf, device=device)
        self.warp = SimpleNamespace(
            **shared,
            arms_mask=wp.from_torch(self._reset_mask[:n]),
            joint_q=s.joint_q.reshape((n, NUM_JOINTS)),
            joint_qd=s.joint_qd.reshape((n, NUM_JOINTS)),
            body_q=s.body_q.reshape((n, self.model.body_count // n)),
            control=c.joint_target_q.reshape((n, NUM_JOINTS)),
            home=wp.array(HOME, dtype=float, device=device),
            lower=wp.array(robot.lower, dtype=float, device=device),
            upper=wp.array(robot.upper, dtype=float, device=device),
            lead=wp.array(self._lead(), dtype=float, device=device),
            parent_frames=wp.array(robot.parent_frames, **frames),
            child_frames=wp.array(robot.child_frames, **frames),
            axes=wp.array(robot.axes, dtype=wp.vec3f, device=device),
            tool_frame=wp.array(robot.tool_frame.reshape(1, 7), **frames),
            tool_body=robot.tool_body,
            mount=wp.array([wrist_mount(robot.tool_frame)], **frames),
            poses=wp.array([look_at(*camera_framing(self.config))] * n, **frames),
            origins=wp.zeros((n, NUM_JOINTS), dtype=wp.vec3f, device=device),
            directions=wp.zeros((n, NUM_JOINTS), dtype=wp.vec3f, device=device),
        )
        if not self.config.randomization.observation_noise:
            # Without noise what is seen is what is true: the same memory, and no launch between them.
            self.warp.true_state, self.warp.next_true_state = self.warp.state, self.warp.next_state
            self.true_state, self.next_true_state = self.state, self.next_state

    def _allocate_images(self) -> None:
        """Cameras, and by observation key the images of the present and of the last step's end."""
        cfg, n = self.config, self.num_envs
        self.images: dict[str, torch.Tensor] = {}
        self.next_images: dict[str, torch.Tensor] = {}
        self._cameras: list[tuple[Camera, Camera, dict, dict]] = []
        kinds = tuple(k for k in cfg.images if k != "goal_pixels")
        # Worlds that were reset are rendered a second time, few at once: a pass over all views, most of them
        # skipped, costs a tenth of a full one on a GPU.
        some = max(1, n // 16)
        for name in cfg.cameras if kinds else ():
            suffix = "" if name == cfg.cameras[0] else f"_{name}"
            full = Camera(self.model, cfg, name=name, kinds=kinds)
            few = Camera(self.model, cfg, name=name, kinds=kinds, num_views=some)
            after = full.allocate(n)
            self._cameras.append((full, few, full.images, after))
            for kind in kinds:
                self.images[kind + suffix] = as_torch(kind, full.images[kind])
                self.next_images[kind + suffix] = as_torch(kind, after[kind])
        self._goal_cameras: list[tuple[Camera, wp.array, wp.array]] = []
        if "goal_pixels" in cfg.images:
            for name in cfg.cameras:
                camera = Camera(self.model, cfg, name=name, num_views=some)
                now, after = (camera.allocate(n)["pixels"] for _ in range(2))
                self._goal_cameras.append((camera, now, after))
                key = "goal_pixels" if name == cfg.cameras[0] else f"goal_pixels_{name}"
                self.images[key], self.next_images[key] = as_torch("pixels", now), as_torch("pixels", after)
            self._goal_state = self.model.state()
            self._goal_arm = SimpleNamespace(**vars(self.warp))
            self._goal_arm.body_q = self._goal_state.body_q.reshape((n, self.model.body_count // n))
            self._no_speed = wp.zeros_like(self.newton_state.joint_qd)
        self._views = wp.zeros(some, dtype=int, device=self.device)
        self._reset_worlds = wp.zeros(n, dtype=int, device=self.device)
        self._counts = wp.zeros(3, dtype=int, device=self.device)
        if cfg.show_goal:
            labels = enumerate(self.model.shape_label)
            markers = [i for i, label in labels if label.endswith(GOAL_MARKER)]
            self._markers = wp.array(markers, dtype=int, device=self.device)

    # -- the graph ----------------------------------------------------------------------------------------

    def _capture(self, launches: Callable[[], None]) -> wp.Graph:
        """Records the launches of one function; whatever it would have done to the worlds is undone.

        The kernels are compiled, and the solver's buffers allocated, by one run outside the capture, on the
        real arrays; hence the backup.
        """
        device = wp.get_device(self.device)
        arrays = self._mutable()
        backup = [wp.clone(a) for a in arrays]
        with wp.ScopedDevice(device):
            if device.is_cuda:
                torch.cuda.synchronize(self.device)
            self._reset_mask[: self.num_envs] = True
            self._launch_reset_and_observe()  # so that even what only some steps run is compiled before the capture
            launches()
            with wp.ScopedCapture(device=device) as capture:
                launches()
            for array, copy in zip(arrays, backup, strict=True):
                wp.copy(array, copy)
            self.randomizer.apply()  # MuJoCo's copy of the physical values is not among the arrays
            if device.is_cuda:
                wp.synchronize_device(device)
        return capture.graph

    def _mutable(self) -> list[wp.array]:
        """Every array that a launch may change and that outlives it."""
        arrays = [wp.from_torch(t) for t in vars(self).values() if isinstance(t, torch.Tensor)]
        arrays += [a for a in vars(self.warp).values() if isinstance(a, wp.array)]
        arrays += [self.newton_state.body_qd, *self._solver_memory().values(), *self.randomizer.arrays()]
        for _, _, now, after in self._cameras:
            arrays += [*now.values(), *after.values()]
        for _, now, after in self._goal_cameras:
            arrays += [now, after]
        return [a for a in arrays if a is not None and a.size]

    def _solver_memory(self) -> dict[str, wp.array]:
        """What MuJoCo carries from step to step beside positions and velocities; each (N, …)."""
        data = getattr(self.solver, "mjw_data", None)
        names = ("qacc_warmstart", "ctrl", "act", "qfrc_applied", "xfrc_applied")
        return {} if data is None else {name: getattr(data, name) for name in names}

    def _replay(self, graph: wp.Graph) -> None:
        device = wp.get_device(self.device)
        if device.is_cuda:
            # Warp's own stream does not wait for torch's: launch on the one torch is using.
            stream = wp.stream_from_torch(torch.cuda.current_stream(self.device))
            wp.capture_launch(graph, stream=stream)
        else:
            wp.capture_launch(graph)

    def _launch_step_and_restart(self) -> None:
        self._launch_control_step()
        self._launch_reset_and_observe()

    def _launch_step(self) -> None:
        w = self.warp
        self._launch_control_step()
        self._launch_observe(w.true_state, w.joint_target, w.goal)
        self._launch_noise(w.true_state, w.state)

    def _launch_control_step(self) -> None:
        cfg, n, w, d = self.config, self.num_envs, self.warp, self.device
        self._launch_action()
        self._launch_physics()
        self.task.advance(self)
        self._launch_observe(w.next_true_state, w.next_joint_target, w.next_goal)
        wp.launch(
            kernels.catch_nonfinite,
            n,
            [
                w.true_state,
                w.joint_target,
                w.next_true_state,
                w.next_joint_target,
                w.target,
                w.joint_q,
                w.joint_qd,
                w.broken,
            ],
            device=d,
        )
        self.task.judge(self)
        wp.launch(
            kernels.end_step,
            n,
            [
                w.reward, w.success, w.broken, cfg.episode_length, cfg.terminate_on_success,
                w.step_count, w.episode_return, w.episode_success, w.statistics,
                w.terminated, w.truncated, w.done, w.reset_mask,
            ],
            device=d,
        )  # fmt: skip
        self._launch_noise(w.next_true_state, w.next_state)
        if self._cameras:
            # A broken world is shown in its last finite pose; its NaN must not reach the ray tracer's tree.
            self._forward_kinematics(w.broken)
            self._launch_marker()
            self.model.bvh_refit_shapes(self.newton_state)
            for camera, _, now, after in self._cameras:
                camera.render(self.newton_state, w, images=after)
                for kind, image in after.items():
                    wp.copy(now[kind], image)
        for _, now, after in self._goal_cameras:
            wp.copy(after, now)

    def _launch_action(self) -> None:
        cfg, n, w, d = self.config, self.num_envs, self.warp, self.device
        action = w.action
        if cfg.randomization.action_latency or cfg.randomization.action_noise:
            noise = float(cfg.randomization.action_noise)
            inputs = [w.action, w.seed, w.episode, w.step_count, w.delay, noise, w.history, w.applied]
            wp.launch(kernels.perceive_action, n, inputs, device=d)
            action = w.applied
        if cfg.action_mode == "ee_delta":
            wp.launch(
                kernels.apply_tool_action,
                n,
                [
                    action, cfg.ee_scale, cfg.action_scale, w.lower, w.upper, w.lead, w.parent_frames,
                    w.child_frames, w.axes, w.tool_frame, w.joint_q, w.origins, w.directions, w.target, w.control,
                ],
                device=d,
            )  # fmt: skip
        else:
            absolute = cfg.action_mode == "joint_position"
            inputs = [
                action,
                absolute,
                cfg.action_scale,
                w.lower,
                w.upper,
                w.lead,
                w.joint_q,
                w.target,
                w.control,
            ]
            wp.launch(kernels.apply_joint_action, (n, NUM_JOINTS), inputs, device=d)

    def _launch_noise(self, state: wp.array, out: wp.array) -> None:
        noise = self.config.randomization.observation_noise
        if noise:
            w = self.warp
            inputs = [w.seed, w.episode, w.step_count, float(noise), state, out]
            wp.launch(kernels.blur_state, self.num_envs, inputs, device=self.device)

    def _launch_marker(self) -> None:
        if self.config.show_goal:
            inputs = [self.warp.task_goal, self._markers, self.model.shape_transform]
            wp.launch(kernels.move_goal_marker, self.num_envs, inputs, device=self.device)

    def _launch_physics(self) -> None:
        state, spare, w = self.newton_state, self._spare_state, self.warp
        for _ in range(self.config.substeps):
            if self.config.limit_velocity:
                q = state.joint_q.reshape((self.num_envs, NUM_JOINTS))
                wp.launch(
                    kernels.limit_speed,
                    (self.num_envs, NUM_JOINTS),
                    [w.target, w.lead, q, w.control],
                    device=self.device,
                )
            if spare is None:
                self.solver.step(state, state, self.control, None, self._dt)
            else:
                state.clear_forces()
                self.solver.step(state, spare, self.control, None, self._dt)
                state, spare = spare, state

    def _launch_reset_and_observe(self) -> None:
        cfg, n, w, d = self.config, self.num_envs, self.warp, self.device
        if self._in_place:
            self.solver.reset(self.newton_state, w.reset_mask)
        wp.launch(
            kernels.reset_pose,
            n,
            [
                w.arms_mask, w.seed, w.home, cfg.pose_noise, w.lower, w.upper, w.episode, w.joint_q, w.joint_qd,
                w.target, w.control, w.step_count, w.episode_return, w.episode_success, w.history,
                cfg.action_mode == "joint_position",
            ],
            device=d,
        )  # fmt: skip
        self.randomizer.launch(w.arms_mask)
        self.task.reset(self, w.arms_mask)
        self._forward_kinematics(w.arms_mask)
        self._launch_observe(w.true_state, w.joint_target, w.goal)
        self.task.begin(self, w.arms_mask)
        self._launch_noise(w.true_state, w.state)
        if self._cameras or self._goal_cameras:
            self._launch_marker()
            self._counts.zero_()
            wp.launch(kernels.list_worlds, n, [w.arms_mask, self._reset_worlds, self._counts], device=d)
            if self._goal_cameras:
                q = w.goal_q.flatten()
                newton.eval_fk(self.model, q, self._no_speed, self._goal_state)
            wp.capture_while(self._counts[2:], self._render_some)

    def _render_some(self) -> None:
        """Renders the next few of the worlds that were reset into their pictures."""
        d, views, some = self.device, self._views, self._views.shape[0]
        wp.launch(kernels.choose_views, some, [self._reset_worlds, self._counts, SKIP_VIEW, views], device=d)
        if self._goal_cameras:
            self.model.bvh_refit_shapes(self._goal_state)
            for camera, now, _ in self._goal_cameras:
                self._render_into(camera, self._goal_state, self._goal_arm, {"pixels": now})
        self.model.bvh_refit_shapes(self.newton_state)
        for _, few, now, _ in self._cameras:
            self._render_into(few, self.newton_state, self.warp, now)
        wp.launch(kernels.advance_views, 1, [some, self._counts, self._counts[2:]], device=d)

    def _render_into(self, camera: Camera, state: newton.State, arm: SimpleNamespace, images: dict) -> None:
        wp.copy(camera.views, self._views)
        camera.render(state, arm)
        shape = (camera.num_views, camera.size, camera.size)
        for kind, image in images.items():
            inputs = [camera.views, camera.images[kind], image]
            wp.launch(kernels.PLACE[kind], shape, inputs, device=self.device)

    def _launch_observe(self, state: wp.array, joint_target: wp.array, goal: wp.array) -> None:
        w = self.warp
        wp.launch(
            kernels.observe,
            self.num_envs,
            [w.joint_q, w.joint_qd, w.body_q, self.robot.tool_body, w.tool_frame, w.target, w.task_goal,
             state, joint_target, goal],
            device=self.device,
        )  # fmt: skip

    def _forward_kinematics(self, mask: wp.array) -> None:
        s = self.newton_state
        newton.eval_fk(self.model, s.joint_q, s.joint_qd, s, mask=mask)


def _as_int32(seed: int) -> int:
    """Any Python integer as the 32-bit one that Warp's generator takes."""
    seed &= 0xFFFFFFFF
    return seed - (1 << 32) if seed >= 1 << 31 else seed
