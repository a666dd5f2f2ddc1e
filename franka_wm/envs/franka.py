# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
# pyright: reportCallIssue=false, reportReturnType=false, reportIndexIssue=false
# (Warp's and TorchRL's annotations know neither vectors nor shapes as tuples.)
"""``FrankaEnv``: N Franka arms as one TorchRL environment."""

from __future__ import annotations

import copy
import itertools
import logging
import multiprocessing
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from franka_wm.device import resolve_device
from franka_wm.envs.camera import Camera, as_torch, camera_framing
from franka_wm.envs.config import FrankaConfig
from franka_wm.envs.frames import FrameStack
from franka_wm.envs.simulation import Simulation
from franka_wm.envs.specs import LOST, MARKS, check_state, goals_given, observation_spec
from franka_wm.envs.start import check_arguments, check_robot, check_task
from franka_wm.envs.tasks import Task, goal_distance
from franka_wm.errors import UserError
from franka_wm.options import check_whole
from franka_wm.seeding import derive_seed

log = logging.getLogger(__name__)

FLAGS = ("done", "terminated", "truncated")

_unseeded = itertools.count()


def own_seed() -> int:
    """An environment's seed where none is given: of its number in this process; the same when it is run again.

    Workers of a ``ParallelEnv`` or of a collector count alike, and torchrun's processes do. So the place among the
    parent's children, (), (2,) or (2, 1), and the rank are parts of it."""
    place, rank = getattr(multiprocessing.current_process(), "_identity", ()), os.environ.get("RANK") or "0"
    return derive_seed("worlds", next(_unseeded), *place, *([] if rank == "0" else [f"rank {rank}"]))


class FrankaEnv(EnvBase):
    """N simulated Franka arms and their task, as a TorchRL environment; everything stays on ``device``.

    The leading dimension is always N, also for N = 1:

    ==================  ======================  ==================================================================
    key                 shape, dtype            meaning
    ==================  ======================  ==================================================================
    ``pixels``          (N, H, W, 3) uint8      the camera; present when asked for; 3 · ``frame_stack`` channels
    ``state``           (N, 20) float32         joints 7 [rad], velocities 7 [rad/s], tool 3 [m], tool − goal 3 [m];
                                                with a gripper 28: fingers 2 [m], their speeds 2, tool's x y z w
    ``objects``         (N, 13 · K) float32     of each: place, x y z w, velocity, angular velocity; of drawers more
    ``joint_target``    (N, 7) float32          the servo's commanded angles [rad]; with a gripper 8: its opening [m]
    ``goal``            (N, 3) float32          where the tool, or the task's object, shall be [m]
    ``success``         (N, 1) bool             as the task says: of reach, tool within ``success_distance``
    ``is_init``         (N, 1) bool             first observation of an episode
    ``action``          (N, 7) float32          in [−1, 1]: change of the joint targets, × ``action_scale``; an eighth
                                                is the gripper's: −1 closed, 1 open
    ``reward``          (N, 1) float32          the task's: of reach, −tanh(distance) − penalty · mean(action²)
    ``overflow``        (N, 1) bool             with a scene: contacts were lost in the step; not to be learned from
    ``done``, …         (N, 1) bool             ``terminated`` by success (if asked), ``truncated`` by time
    ==================  ======================  ==================================================================

    **Auto-reset.** ``("next", …)`` holds the *true last observation* of a finished episode, and the following
    step's root the first of the next one. This is so under any wrapper and collector of TorchRL's: a world that
    is finished stays so until it is reset, and every episode is played. With ``auto_reset="native"`` worlds
    restart inside :meth:`step_and_maybe_reset`, which a collector calls and which hands over the new episode's
    first observation: no host sync, nothing stepped or rendered twice. A plain ``TransformedEnv`` asks the device
    whether a world is done and resets by mask; :class:`TransformedFrankaEnv` does not ask.

    **A world that is no longer finite** is put back to its last finite observation, truncated, reset and
    counted (``statistics()["nonfinite"]``): physics emits no NaN.

    **Randomness** depends on seed × world × episode alone: world k sees the same episodes whatever N is.

    Args:
        config: The arm and its task; :class:`FrankaConfig` lists every field.
        num_envs: Number of worlds, N ≥ 1.
        device: ``None`` or ``"auto"`` (GPU where there is one), ``"cpu"``, ``"cuda"``, ``"cuda:K"``.
        seed: Seed of all randomness. ``None``: one that no other instance has (:func:`own_seed`), so that the
            environments of a ``SerialEnv`` or ``ParallelEnv`` play different episodes.
        first_world: Number of the first world: environments of one seed then divide its worlds among them.
        urdf_path: A robot of your own.
        task: A task of your own (:class:`~franka_wm.envs.tasks.Task`); the config's if not given.

    Raises:
        UserError: One line, for anything that cannot be built.

    Example::

        env = FrankaEnv(FrankaConfig(observations=("state",)), num_envs=1024)
        rollout = env.rollout(100, policy, break_when_any_done=False)
    """

    device: torch.device

    def __init__(
        self,
        config: FrankaConfig | None = None,
        *,
        num_envs: int = 1,
        device: torch.device | str | None = None,
        seed: int | None = None,
        first_world: int = 0,
        urdf_path: str | Path | None = None,
        task: Task | None = None,
    ):
        config = FrankaConfig() if config is None else config
        seed = own_seed() if seed is None else seed
        check_arguments(config, num_envs, seed, first_world)
        device = resolve_device(device)
        super().__init__(device=device, batch_size=torch.Size([num_envs]))
        if task is None:
            check_robot(config, urdf_path)
        elif isinstance(task, Task):
            task = copy.copy(task)  # another environment may be given it, too
            config = task.config = check_task(task, replace(config, **task.brings()), urdf_path)
        else:
            raise UserError(f"task={task!r}: must be an instance of Task; by name: FrankaConfig(task=NAME)")
        self.config = config
        self.urdf_path = None if urdf_path is None else str(urdf_path)
        self.num_envs = num_envs = int(num_envs)
        started = time.perf_counter()
        log.info("building %d worlds on %s with seed %d", num_envs, device, seed)
        self.simulation = Simulation(
            config, num_envs, str(device), seed=seed, first_world=first_world, urdf_path=urdf_path, task=task
        )
        self.kinematics = self.simulation.kinematics
        seconds = time.perf_counter() - started
        log.info("built in %.1f s; the first reset and step compile what is not cached yet", seconds)
        self._restart = False  # whether the step under way begins the next episode of finished worlds
        self._stack = FrameStack(config.frame_stack) if config.frame_stack > 1 else None
        images = self.simulation.renderer.images
        self._stacked = [key for key in images if self._stack and key.startswith("pixels")]
        self.observation_spec = observation_spec(config, list(images), self.kinematics, num_envs, device)
        self._observed = [key for key in self.observation_spec if key not in MARKS]
        self._marks = [key for key in self.observation_spec if key in MARKS]
        self.action_spec = Bounded(-1.0, 1.0, shape=(num_envs, config.action_dim), device=device)
        self.reward_spec = Unbounded(shape=(num_envs, 1), device=device)
        flags = {key: Binary(shape=(num_envs, 1), dtype=torch.bool, device=device) for key in FLAGS}
        self.done_spec = Composite(**flags, shape=(num_envs,), device=device)
        self._renderers: dict[tuple, Camera] = {}

    # -- TorchRL ------------------------------------------------------------------------------------------

    def _reset(
        self, tensordict: TensorDictBase | None = None, *, seed: int | None = None, **_
    ) -> TensorDictBase:
        sim = self.simulation
        if seed is not None:
            self._set_seed(seed)
        mask = None if tensordict is None else tensordict.get("_reset", None)
        sim.reset(mask)
        for key in self._stacked:
            self._stack.restart(key, sim.renderer.images[key], sim.tensors.mask)
        out = self._present() | self._unmarked() | {"is_init": sim.tensors.mask.clone().unsqueeze(-1)}
        return TensorDict(out, batch_size=self.batch_size, device=self.device)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        sim = self.simulation
        action = tensordict.get("action", None)
        expected = tuple(sim.tensors.action.shape)
        if action is None or action.shape != expected:
            given = "there is no action" if action is None else f"action has shape {tuple(action.shape)}"
            raise UserError(f"{given}; it must be {expected}: (worlds, joints)")
        sim.tensors.action.copy_(action.detach())  # else the graphs of all steps hang on each other, for ever
        sim.step(restart=self._restart)
        for key in self._stacked:
            self._stack.push(key, sim.renderer.next_images[key])
        out = self._present(sim.renderer.next_images, "next_")
        if self._restart:  # the next episode has begun where one has ended
            for key in self._stacked:
                self._stack.restart(key, sim.renderer.images[key], sim.tensors.done.squeeze(-1))
        for key in ("success", "reward", "done", "terminated", "truncated"):
            out[key] = getattr(sim.tensors, key).clone()
        out["is_init"] = torch.zeros_like(sim.tensors.done)
        if LOST in self._marks:
            out[LOST] = (sim.tensors.overflow != 0).unsqueeze(-1)
        return TensorDict(out, batch_size=self.batch_size, device=self.device)

    def _step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """What ``step_and_maybe_reset`` calls: only here is the new episode's first observation handed over.

        So only here may worlds restart inside the step. Whatever steps the environment in another way (a
        ``TransformedEnv``, a ``SerialEnv``, ``step`` by hand) finds its finished worlds finished, and resets them.
        """
        if self.config.auto_reset == "standard":
            return super()._step_and_maybe_reset(tensordict)
        if tensordict.device != self.device:
            tensordict = tensordict.to(self.device)
        with self.restarting():
            tensordict = self.step(tensordict)
        following = self._step_mdp(tensordict)
        done = following.get("done")
        following.update(self._present())
        following.set("success", following.get("success") & ~done)
        following.set("is_init", done.clone())
        for key in {*FLAGS, LOST} & {*following.keys()}:
            following.set(key, torch.zeros_like(done))
        return tensordict, following

    @contextmanager
    def restarting(self) -> Iterator[None]:
        """Steps inside begin the next episode of finished worlds."""
        self._restart = True
        try:
            yield
        finally:
            self._restart = False

    def _present(
        self, images: dict[str, torch.Tensor] | None = None, prefix: str = ""
    ) -> dict[str, torch.Tensor]:
        """Copies of what is observed now; of what an action led to, with its images and ``next_``."""
        sim = self.simulation
        images = sim.renderer.images if images is None else images
        return {
            key: self._image(key, images) if key in images else getattr(sim.tensors, prefix + key).clone()
            for key in self._observed
        }

    def _image(self, key: str, images: dict[str, torch.Tensor]) -> torch.Tensor:
        """A copy of an image as it is observed; images of the goal, which stands still, are stacked alike."""
        if self._stack is None:
            return images[key].clone()
        if key in self._stacked:
            return self._stack[key]
        return self._stack.still(images[key]) if key.startswith("goal_pixels") else images[key].clone()

    def get_state(self) -> TensorDict:
        """Everything that the futures of the worlds depend on, batch size (N,): a checkpoint of the simulation.

        Index it, save it, or branch from it: ``state[3].expand(N)`` is world 3, N times.
        """
        state = self.simulation.get_state()
        if self._stack is not None:
            state |= {f"frames_{key}": frames.clone() for key, frames in self._stack.memory().items()}
        return TensorDict(state, batch_size=self.batch_size, device=self.device)

    def set_state(self, state: TensorDictBase) -> TensorDict:
        """Puts all worlds where :meth:`get_state` found them and returns what they observe, as a reset does.

        The same actions then lead to the same states, bit for bit on the CPU. Resets and noise draw by a world's
        own number: branches are alike until the first of them.

        Raises:
            UserError: It is no state, or one of another config or number of worlds; nothing is changed then.
        """
        sim = self.simulation
        check_state(state, self.batch_size)
        frames = {key: state.get(f"frames_{key}", None) for key in self._stacked}
        for key, stacked in frames.items():
            spec = self.observation_spec[key]
            if stacked is None or stacked.shape != spec.shape or stacked.dtype != spec.dtype:
                raise UserError(
                    f"set_state: frames_{key} must be {tuple(spec.shape)} {spec.dtype}; take the state from "
                    "get_state() of an environment with the same config that was reset"
                )
        sim.set_state(dict(state.items()))
        if self._stack is not None:
            self._stack.load({key: stacked.to(self.device) for key, stacked in frames.items()})
        return self._observed_anew()

    def set_goal(self, goal: torch.Tensor) -> TensorDict:
        """Moves the goals to ``goal`` and returns what the worlds observe now, as a reset does.

        Each world keeps its goal until its next episode draws another. With ``task="track"`` the circle is
        moved so that the goal passes there now. Nothing else changes; with ``reward="normalized"`` the episode's
        initial distance stays what it was. It is for use by hand: a goal out of reach is allowed, however far, and the
        arm gets as near as it can.

        Args:
            goal: (N, 3), or (3,) for all worlds [m], in the world's frame.

        Raises:
            UserError: Another shape, a number that is not finite, or, with ``task="track"``, less than 5 cm above the
                ground; nothing is changed then.
        """
        lowest = self.simulation.task.lowest_goal
        self.simulation.set_goal(goals_given(goal, self.num_envs, self.device, lowest))
        return self._observed_anew()

    def _observed_anew(self) -> TensorDict:
        """What the worlds observe after something was set by hand."""
        sim = self.simulation
        for key in self._stacked:  # a goal marker may have moved in it
            self._stack.replace(key, sim.renderer.images[key])
        out = self._present() | self._unmarked() | {"is_init": sim.tensors.step_count == 0}
        return TensorDict(out, batch_size=self.batch_size, device=self.device)

    def _unmarked(self) -> dict[str, torch.Tensor]:
        """Flags where no step has led."""
        return {key: torch.zeros_like(self.simulation.tensors.done) for key in (*self._marks, *FLAGS)}

    def _set_seed(self, seed: int | None) -> None:
        self.simulation.set_seed(own_seed() if seed is None else int(seed))

    # -- the arm ------------------------------------------------------------------------------------------

    @property
    def model(self):
        """The Newton model of all worlds."""
        return self.simulation.model

    @property
    def state(self):
        """The Newton state of all worlds; what the next step changes."""
        return self.simulation.newton_state

    @property
    def action_dim(self) -> int:
        return self.config.action_dim

    @property
    def state_dim(self) -> int:
        return self.config.state_dim

    @property
    def terminates(self) -> bool:
        """Whether episodes may end by more than their length."""
        return self.config.terminate_on_success

    @property
    def reward_bounds(self) -> tuple[float, float] | None:
        """The least and the largest reward of a step; ``None`` where the task does not say."""
        return self.simulation.task.reward_bounds

    @property
    def goal(self) -> torch.Tensor:
        """(N, 3) [m]."""
        return self.simulation.tensors.goal.clone()

    @property
    def camera_framing(self) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        """(eye, target) in world metres, shared by every renderer."""
        return camera_framing(self.config)

    def joint_positions(self) -> torch.Tensor:
        """(N, 7) [rad]."""
        return self.simulation.tensors.state[:, :7].clone()

    def joint_targets(self) -> torch.Tensor:
        """The servo's commanded angles, (N, 7) [rad]; with a gripper (N, 8), the last a finger's place [m]."""
        return self.simulation.tensors.joint_target.clone()

    def tool_position(self) -> torch.Tensor:
        """The hand's centre point, (N, 3) [m]."""
        return self.simulation.tensors.state[:, 14:17].clone()

    def body_positions(self) -> torch.Tensor:
        """Origins of the moving links, (N, bodies, 3) [m]; fixed links are merged into what carries them."""
        return self.simulation.tensors.body_q[..., :3].clone()

    def state_observation(self) -> torch.Tensor:
        """(N, 20), with a gripper (N, 28), as under the key ``state``."""
        return self.simulation.tensors.state.clone()

    def goal_distance(self) -> torch.Tensor:
        """Tool to goal, (N,) [m]."""
        return goal_distance(self.simulation.tensors.state)

    def reward(self, action: torch.Tensor) -> torch.Tensor:
        """Reward of having applied ``action`` (N, `action_dim`) and being in the present state, (N, 1).

        Raises:
            UserError: A task of one's own has its reward in a kernel: read it from a step.
        """
        return self.simulation.task.present_reward(self.simulation, action)

    def is_finite(self) -> torch.Tensor:
        """(N,) bool: health of each world's present state."""
        return torch.isfinite(self.simulation.tensors.state).all(-1)

    def observe(self) -> torch.Tensor:
        """The camera's image now, (N, 3, H, W) float32 in [0, 1] at ``image_size``."""
        return self.render(self.config.image_size).permute(0, 3, 1, 2).float().div_(255.0)

    def render(
        self, size: int | None = None, samples: int = 1, num_views: int | None = None, *,
        config: FrankaConfig | None = None,
    ) -> torch.Tensor:  # fmt: skip
        """The camera's image now, (views, size, size, 3) uint8, for people and videos.

        Args:
            size: Side [px]; ``image_size`` if not given.
            samples: Anti-aliasing: ``samples``² rays per pixel.
            num_views: The first so many worlds; all if not given.
            config: Where the camera stands; the environment's if not given. :func:`~franka_wm.envs.camera.whole_arm`.
        """
        size = self.config.image_size if size is None else size
        views = self.num_envs if num_views is None else min(num_views, self.num_envs)
        for name, value in {"size": size, "samples": samples, "num_views": views}.items():
            check_whole(name, value)
        key = (size, samples, config := config or self.config)
        camera = self._renderers.get(key)
        if camera is None or camera.num_views != views:
            camera = Camera(self.model, config, size=size, num_views=views, samples=samples)
            self._renderers[key] = camera
        sim = self.simulation
        with sim.recorder.on_stream_of_torch():
            sim.renderer.launch_marker()
            self.model.bvh_refit_shapes(sim.newton_state)
            camera.render(sim.newton_state, sim.warp, sim.chain)
        return as_torch("pixels", camera.images["pixels"]).clone(memory_format=torch.contiguous_format)

    def high_quality_renderer(self, **options):
        """A :class:`~franka_wm.envs.high_quality.HighQualityRenderer` on this model, aimed by the same framing."""
        from franka_wm.envs.high_quality import high_quality_renderer

        return high_quality_renderer(self, **options)

    def rollout_actions(self, actions: torch.Tensor, *, seed: int | None = None) -> TensorDict:
        """Plays a sequence of actions from a fresh (seeded) reset.

        Args:
            actions: (N, T, 7).
            seed: Seed of the reset.

        Returns:
            ``state`` (N, T + 1, 20), ``joint_q`` (N, T + 1, 7), ``tool`` (N, T + 1, 3), ``reward`` (N, T, 1),
            ``done`` (N, T, 1), and ``video`` (N, T + 1, H, W, 3) uint8 if the environment observes pixels.
            Batch size (N,). An episode that ends within T steps goes on in its next one.
        """
        from franka_wm.envs.sequences import play_actions

        return play_actions(self, actions, seed)

    def statistics(self, *, clear: bool = True) -> dict[str, float]:
        """Means over the episodes that ended since the last call; one host sync.

        Returns:
            ``episodes`` (count), ``return``, ``length``, ``success`` (at the end), ``success_once`` (means;
            absent when no episode ended), ``nonfinite`` (count of broken worlds) and, with a scene, ``overflow``
            (count of steps that lost contacts for want of room; such a world is truncated).
        """
        return self.simulation.statistics(clear=clear)
