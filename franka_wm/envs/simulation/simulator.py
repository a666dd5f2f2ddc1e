# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportOptionalMemberAccess=false
# (Warp's annotations know neither vectors nor shapes as tuples.)
"""``Simulation``: N worlds, stepped and reset. Each step is one graph launch, on CUDA and on the CPU:

    actions → servo targets → physics → observation → task → ends of episodes → images
            → masked reset → observation → images of the worlds that were reset

Without the second line, for who resets finished worlds by himself, it is another graph.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from pathlib import Path

import newton
import torch
import warp as wp

from franka_wm.envs.config import FrankaConfig
from franka_wm.envs.constants import NUM_JOINTS
from franka_wm.envs.kernels import episodes, observation, randomization, servo
from franka_wm.envs.kinematics import Kinematics
from franka_wm.envs.randomize import Randomizer
from franka_wm.envs.simulation import state as worlds
from franka_wm.envs.simulation.arrays import STATISTICS, allocate, as_int32
from franka_wm.envs.simulation.bodies import Bodies
from franka_wm.envs.simulation.build import Chain, build_model, make_solver
from franka_wm.envs.simulation.compiling import (
    Compiler,
    compile_collisions,
    physics_modules,
    solver_modules,
    step_modules,
)
from franka_wm.envs.simulation.demonstrated import DemonstratedStarts
from franka_wm.envs.simulation.graph import Recorder, Recording
from franka_wm.envs.simulation.pipeline import Pipeline
from franka_wm.envs.simulation.rendering import Renderer
from franka_wm.envs.tasks import Task, make_task

log = logging.getLogger(__name__)


class Simulation:
    """N simulated arms. Knows nothing of TorchRL.

    Args:
        config: The arm and its task.
        num_envs: Number of worlds, N.
        device: ``"cpu"`` or ``"cuda:k"``.
        seed: Decides, with world and episode number, all randomness.
        first_world: Number of the first world; the others follow.
        urdf_path: Overrides the robot that the config names.
        task: What is asked of the arm; the config's if not given.

    Attributes:
        tensors, warp: Everything that a step reads and writes, as torch tensors and as Warp arrays over the same
            memory (:class:`~franka_wm.envs.simulation.arrays.Arrays`).
        chain: The robot as kernels read it.
        renderer: Cameras, and the images of the present and of the last step.
        model, newton_state, control, solver: Newton's.
    """

    def __init__(
        self,
        config: FrankaConfig,
        num_envs: int,
        device: str,
        *,
        seed: int = 0,
        first_world: int = 0,
        urdf_path: str | Path | None = None,
        task: Task | None = None,
    ):
        self.config = config
        self.num_envs = num_envs
        self.device = device
        self._dt = 1.0 / (config.fps * config.substeps)
        self._step_graphs: dict[bool, Recording] = {}
        self._reset_graph: Recording | None = None
        self._overflowed = False
        kind = config.task_class if task is None else type(task)
        # Warp's default device is one for all threads.
        with wp.ScopedDevice(device), Compiler(device) as compiler:
            loading = compiler.begin(solver_modules(config))
            self.model, self.robot = build_model(config, kind, num_envs, device, urdf_path)
            compiler.finish(loading)
            around = compiler.begin(step_modules(config, kind))
            self.solver = make_solver(self.model, config)
            self._in_place = isinstance(self.solver, newton.solvers.SolverMuJoCo)
            compiler.finish(around)
            modules = physics_modules(self.solver) if self._in_place and compiler.ahead else []
            collide = bool(config.resolved_scene) and config.collision_pipeline == "mujoco"
            slowest = [lambda: compile_collisions(self.solver)] if collide else []
            physics = compiler.begin_calls(slowest) + compiler.begin(modules)
            self.newton_state = self.model.state()
            self._spare_state = None if self._in_place else self.model.state()
            self.control = self.model.control()
            self.kinematics = Kinematics(self.robot, device)
            self.chain = Chain.of(self.robot, config, device)
            self.task = make_task(config) if task is None else task
            draws = self.task.num_draws
            self.tensors, self.warp = allocate(
                config,
                self.model,
                self.newton_state,
                self.control,
                seed=seed,
                first_world=first_world,
                draws=draws,
            )
            self.bodies = Bodies(self) if config.has_gripper else None
            self.pipeline = Pipeline(self) if config.collision_pipeline == "newton" else None
            self.randomizer = Randomizer(self)
            self.starts: DemonstratedStarts | None = None
            self.recorder = Recorder(device)
            self.renderer = Renderer(self)
            newton.eval_fk(self.model, self.model.joint_q, self.model.joint_qd, self.newton_state)
            if self.renderer.images and compiler.ahead:
                self.renderer.show_all()
            compiler.finish(physics)

    # -- what a user of this class calls ------------------------------------------------------------------

    def step(self, *, restart: bool = True) -> None:
        """One control step of all worlds with ``tensors.action``; one graph launch, no host sync.

        Args:
            restart: Whether finished worlds begin their next episode at once. Where they do not, they stay
                ``done`` until :meth:`reset` begins it.
        """
        if restart not in self._step_graphs:
            self._step_graphs[restart] = self.record(
                self._launch_step_and_restart if restart else self._launch_step
            )
        self.recorder.replay(self._step_graphs[restart])

    def reset(self, mask: torch.Tensor | None = None) -> None:
        """Starts the next episode where ``mask`` (N,) is true, or everywhere; other worlds are untouched."""
        if mask is None:
            self.tensors.mask.fill_(True)
        else:
            self.tensors.mask.copy_(mask.reshape(self.num_envs))
        self._reset_masked()

    def set_seed(self, seed: int) -> None:
        """The next reset of each world is its episode 0 of this seed."""
        self.tensors.seed[0] = as_int32(seed)
        self.tensors.episode.fill_(-1)

    def start_along(self, steps: Mapping[str, torch.Tensor], begins: torch.Tensor, share: float) -> None:
        """From the next reset on, a share of the episodes begins in a recorded state: :class:`DemonstratedStarts`."""
        self.starts = DemonstratedStarts(self, steps, begins, share)
        self._step_graphs.clear()  # recorded without
        self._reset_graph = None

    def set_first_world(self, number: int) -> None:
        """From the next reset on, these worlds play the episodes of those from ``number``."""
        self.tensors.seed[1] = number

    def statistics(self, *, clear: bool = True) -> dict[str, float]:
        """Counts and means over the episodes that ended since the last call; one host sync."""
        totals = dict(zip(STATISTICS, self.tensors.statistics.sum(0).tolist(), strict=True))
        if clear:
            self.tensors.statistics.zero_()
        counts = ("episodes", "nonfinite", *(["overflow"] if self.config.resolved_scene else []))
        out = {key: totals[key] for key in counts}
        if out.get("overflow") and not self._overflowed:
            self._overflowed = True
            log.warning(
                "contacts were lost for want of room, those worlds were truncated: raise max_contacts"
            )
        if totals["episodes"]:
            out |= {key: totals[key] / totals["episodes"] for key in STATISTICS[1:5]}
        return out

    def get_state(self) -> dict[str, torch.Tensor]:
        """A copy of everything that the worlds' futures depend on, by name, each (N, …)."""
        return worlds.read(self)

    def check_state(self, state: Mapping[str, torch.Tensor]) -> None:
        """Raises UserError where :meth:`set_state` would; nothing is changed."""
        worlds.check(self, state)

    def set_state(self, state: Mapping[str, torch.Tensor]) -> None:
        """Puts all worlds where :meth:`get_state` found them; its arrays have N rows.

        Raises:
            UserError: An array is missing or has another shape; nothing is changed then.
        """
        worlds.write(self, state)
        self._observe_anew()
        if self.renderer.images:
            self.renderer.show_all()

    def set_goal(self, goal: torch.Tensor) -> None:
        """Moves every world's goal to ``goal`` (N, 3) [m], until its next reset; no host sync."""
        t = self.tensors
        t.task_goal.copy_(goal)
        self.task.goal_was_set(self)
        t.goal_q.copy_(self.kinematics.solve(goal, t.goal_q, iterations=24))
        if self.bodies:
            self.bodies.move_goal()
        self._observe_anew()
        self.renderer.show_goal()

    def record(self, launches: Callable[[], None]) -> Recording:
        """What ``launches`` launches, recorded for :meth:`Recorder.replay`; the worlds stay as they are."""

        def reset_everywhere() -> None:
            self.tensors.mask.fill_(True)
            self._launch_reset_and_observe()

        state = self.newton_state
        arrays = [array for array in self.warp if array.is_contiguous]
        arrays += [state.joint_q, state.joint_qd, self.control.joint_target_q]  # whose columns have names
        arrays += [self.model.joint_X_p]  # of which bases are rows
        arrays += [state.body_qd, *worlds.solver_memory(self).values()]
        arrays += [*self.randomizer.arrays(), *self.renderer.arrays()]
        # MuJoCo's copy of the physical values is not among the arrays.
        return self.recorder.record(launches, arrays, reset_everywhere, self.randomizer.apply)

    # -- the graph ----------------------------------------------------------------------------------------

    def _reset_masked(self) -> None:
        if self._reset_graph is None:
            self._reset_graph = self.record(self._launch_reset_and_observe)
        self.recorder.replay(self._reset_graph)

    def _observe_anew(self) -> None:
        """The present observation after the arrays behind it were written by hand; resets no world."""
        self.tensors.reset_mask.zero_()
        self._reset_masked()

    def _launch_step_and_restart(self) -> None:
        self._launch_control_step()
        self._launch_reset_and_observe()

    def _launch_step(self) -> None:
        w = self.warp
        self._launch_control_step()
        self.launch_forward_kinematics(w.broken)  # their links are not finite yet; a reset would mend them
        self._launch_observe(w.true_state, w.joint_target, w.goal, w.true_objects)
        self._launch_noise(w.true_state, w.state, w.true_objects, w.objects)

    def _launch_control_step(self) -> None:
        cfg, w = self.config, self.warp
        self._launch_action()
        self.launch_physics()
        self.task.advance(self)
        self._launch_observe(w.next_true_state, w.next_joint_target, w.next_goal, w.next_true_objects)
        if self.bodies:
            self.bodies.launch_contacts()
            self.bodies.launch_mark_nonfinite()
        self._launch(
            observation.catch_nonfinite,
            w.true_state, w.joint_target, w.next_true_state, w.next_joint_target, w.target, w.joint_q, w.joint_qd,
            w.broken,
        )  # fmt: skip
        if self.bodies:
            self.bodies.launch_restore()
            self.bodies.launch_show_contacts()
            self.bodies.launch_cut_short()
        self.task.reward_and_success(self)
        self._launch(
            episodes.end_step,
            w.reward, w.broken, w.overflow, w.cut, cfg.episode_length, cfg.terminate_on_success, w.success,
            w.step_count, w.episode_return, w.episode_success, w.ended, w.statistics,
            w.terminated, w.truncated, w.done, w.reset_mask,
        )  # fmt: skip
        self._launch_noise(w.next_true_state, w.next_state, w.next_true_objects, w.next_objects)
        self.renderer.launch_step()

    def _launch_action(self) -> None:
        cfg, w, c = self.config, self.warp, self.chain
        action = w.action
        if cfg.randomization.action_latency or cfg.randomization.action_noise:
            noise = float(cfg.randomization.action_noise)
            inputs = [w.action, w.seed, w.episode, w.step_count, w.delay, noise, w.history, w.applied]
            self._launch(servo.perceive_action, *inputs)
            action = w.applied
        if cfg.action_mode == "ee_delta":
            self._launch(
                servo.apply_tool_action,
                action, cfg.ee_scale, cfg.action_scale, c.lower, c.upper, c.lead, c.parent_frames,
                c.child_frames, c.axes, c.tool_frame, w.joint_q, w.origins, w.directions, w.target, w.control,
            )  # fmt: skip
        else:
            absolute = cfg.action_mode == "joint_position"
            inputs = [absolute, cfg.action_scale, c.lower, c.upper, c.lead, w.joint_q, w.target, w.control]
            self._launch_joints(servo.apply_joint_action, action, *inputs)
        if self.bodies:
            self.bodies.launch_grip(action)

    def launch_physics(self) -> None:
        """The physics of one control step."""
        state, spare, w = self.newton_state, self._spare_state, self.warp
        if self.bodies:
            self.bodies.begin_step()
        for _ in range(self.config.substeps):
            if self.config.limit_velocity:
                q = w.joint_q if spare is None else state.joint_q.reshape((self.num_envs, NUM_JOINTS))
                self._launch_joints(servo.limit_speed, w.target, self.chain.lead, q, w.control)
            if spare is None:
                contacts = self.pipeline.find() if self.pipeline else None
                self.solver.step(state, state, self.control, contacts, self._dt)
                if self.bodies:
                    self.bodies.after_substep()
            else:
                state.clear_forces()
                self.solver.step(state, spare, self.control, None, self._dt)
                state, spare = spare, state

    def _launch_reset_and_observe(self) -> None:
        cfg, w, c = self.config, self.warp, self.chain
        if self._in_place:
            self.solver.reset(self.newton_state, w.reset_mask)
        self._launch(
            episodes.reset_pose,
            w.mask, w.seed, c.home, cfg.pose_noise, c.lower, c.upper, w.episode, w.joint_q, w.joint_qd,
            w.target, w.control, w.step_count, w.episode_return, w.episode_success, w.ended, w.history,
            cfg.action_mode == "joint_position",
        )  # fmt: skip
        self.randomizer.launch(w.mask)  # sizes, before objects are placed
        if self.bodies:
            self.bodies.launch_place(w.mask)
        if self.task.num_draws:
            self._launch(randomization.draw_uniform, w.mask, w.seed, w.episode, w.draws)
        self.task.reset(self, w.mask)
        if self.starts is not None:
            self.starts.launch(w.mask)
        if self.bodies:
            self.bodies.launch_goal(w.mask)
        self.launch_forward_kinematics(w.mask)
        self._launch_observe(w.true_state, w.joint_target, w.goal, w.true_objects)
        self.task.begin(self, w.mask)
        self._launch_noise(w.true_state, w.state, w.true_objects, w.objects)
        self.renderer.launch_reset()

    def _launch_observe(
        self, state: wp.array, joint_target: wp.array, goal: wp.array, objects: wp.array
    ) -> None:
        w, c = self.warp, self.chain
        inputs = [w.joint_q, w.joint_qd, w.body_q, c.tool_body, c.tool_frame, w.target, w.task_goal]
        self._launch(observation.observe, *inputs, state, joint_target, goal)
        if self.bodies:
            self.bodies.launch_observe(state, joint_target, objects)

    def _launch_noise(self, state: wp.array, out: wp.array, objects: wp.array, objects_out: wp.array) -> None:
        cfg, w = self.config, self.warp
        ranges, when = cfg.randomization, [w.seed, w.episode, w.step_count]
        if ranges.observation_noise:
            self._launch(observation.blur_state, *when, float(ranges.observation_noise), state, out)
        if ranges.object_noise:
            inputs = [float(ranges.object_noise), cfg.num_objects + cfg.num_articulated, objects, objects_out]
            self._launch(observation.blur_objects, *when, *inputs)

    def launch_forward_kinematics(self, mask: wp.array) -> None:
        """Frames of the links of the masked worlds from their joints."""
        s = self.newton_state
        if self.bodies:
            mask = self.bodies.articulation_mask(mask)
        newton.eval_fk(self.model, s.joint_q, s.joint_qd, s, mask=mask)

    def _launch(self, kernel: wp.Kernel, *inputs) -> None:
        """One thread for each world."""
        wp.launch(kernel, self.num_envs, inputs, device=self.device)

    def _launch_joints(self, kernel: wp.Kernel, *inputs) -> None:
        """One thread for each joint of each world."""
        wp.launch(kernel, (self.num_envs, NUM_JOINTS), inputs, device=self.device)
