"""One arm, simulated at the environment's own rate while somebody watches, drags its goal and switches policies.

Nothing here knows of browsers: the page listens to :class:`Frame`s and calls the methods of :class:`Session`.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from franka_wm.envs.transformed import arm_of
from franka_wm.errors import UserError
from franka_wm.live.commanded import planned_path
from franka_wm.live.frame import Frame
from franka_wm.live.objects import free_objects, move_object, point_over_table, touching
from franka_wm.live.recorder import DatasetRecorder, VideoRecorder
from franka_wm.live.sliders import Setting, place_of, planner_settings, retuned
from franka_wm.policies.names import refuse_old_name

SPEEDS = (0.1, 1.0)
"""Slowest and fastest, as shares of the environment's own rate."""
FARTHEST = 5.0
"""Largest coordinate of a goal [m]: many times the arm's reach."""
BUDGET = 1.0
"""Longest decision that a planner's settings may lead to [s]: while it plans, nothing else is heard."""

GOAL_NAME = "/goal"
"""What is asked to move, if it is not an object: names of objects have no /."""

PREFERRED = ("planner", "expert", "ik", "noop")
"""Which policy starts, the first one that there is."""


class Session:
    """Simulates one arm with one of several policies; every method may be called from any thread.

    :meth:`step` works without a thread. :meth:`start` runs one that steps at the environment's rate while
    :attr:`playing`, as well as it can: a policy that needs longer slows time down.

    Args:
        env: One world: :class:`~franka_wm.envs.FrankaEnv`, or transforms around one.
        policies: By name; TensorDict modules that write ``action``.
        policy: Who acts first; if not given, the first of :data:`PREFERRED` that there is, else the first of all.
        seed: Seed of poses and goals.

    Raises:
        UserError: More than one world, or a policy that is not there.
    """

    def __init__(
        self,
        env: Any,
        policies: Mapping[str, Any],
        *,
        policy: str | None = None,
        seed: int = 0,
    ):
        arm = arm_of(env)
        assert arm is not None
        self.env, self.arm = env, arm
        if self.arm.num_envs != 1:
            raise UserError(f"a live session simulates one world, the environment has {self.arm.num_envs}")
        self.policies = dict(policies)
        self.seed = seed
        self.keep_goal = False  # whether a goal set by hand outlives the episode
        self.show_contacts = False
        self._touching = False  # whether what the solver holds of contacts is of the present state
        self._speed = 1.0
        self.error: Exception | None = None
        self._lock = threading.RLock()
        self._playing, self._stopping = threading.Event(), threading.Event()
        self._thread: threading.Thread | None = None
        self._listeners: list[Callable[[Frame], None]] = []
        self._recorder: VideoRecorder | DatasetRecorder | None = None
        self._writing = threading.Lock()
        self._steps = self._episode = 0
        self._reward = self._decision = 0.0
        self._success = False
        self._pinned: torch.Tensor | None = None
        self._asked: dict[str, list[float]] = {}
        self._path: torch.Tensor | None = None
        self._policy = policy or next(
            (name for name in (*PREFERRED, *self.policies) if name in self.policies), ""
        )
        self._check_policy(self._policy)
        self._now = env.reset(seed=seed)
        self._observed = list(self._now.keys())
        self._distance = float(self.arm.goal_distance()[0])

    # -- what happens ------------------------------------------------------------------------------------

    @torch.no_grad()
    def step(self) -> Frame:
        """One decision and one control step, played or paused."""
        with self._lock, set_exploration_type(ExplorationType.DETERMINISTIC):
            self._synchronize()
            began = time.perf_counter()
            decided = self.policies[self._policy](self._now)
            self._synchronize()
            self._decision = time.perf_counter() - began
            self._path = planned_path(self.arm, decided)
            done, self._now = self.env.step_and_maybe_reset(decided)
            after = done["next"]
            self._reward = float(after["reward"])
            self._success = bool(after["success"])
            self._distance = float(self.arm.simulation.tensors.next_true_state[0, 17:20].norm())
            self._steps += 1
            self._touching = self.arm.config.resolved_scene is not None
            if bool(after["done"]):
                self._begin_episode()
            if self._recorder is not None:
                self._recorder.take(done)
            frame = self._frame(stepped=True)
        return self._tell(frame)

    def reset(self) -> Frame:
        """The next episode: another pose, and another goal unless :attr:`keep_goal` holds one set by hand."""
        with self._lock:
            self._now = self.env.reset()
            self._begin_episode()
            self._distance = float(self.arm.goal_distance()[0])
            self._reward, self._success = 0.0, False
            frame = self._frame()
        return self._tell(frame)

    def set_goal(self, goal: Sequence[float]) -> Frame:
        """Moves the goal to a point (x, y, z) [m].

        The distance is judged anew, also while paused, and success where it is nothing else.

        Raises:
            UserError: Not three finite numbers, or farther away than `FARTHEST`.
        """
        point = self._checked(goal)
        with self._lock:
            self._place_goal(point)
            self._pinned = point
            self._distance = float(self.arm.goal_distance()[0])
            if (within := self.arm.simulation.task.success_distance) is not None:
                self._success = self._distance < within
            frame = self._frame()
        return self._tell(frame)

    def ask_goal(self, goal: Sequence[float]) -> None:
        """:meth:`set_goal` by the thread, as soon as it can; of several goals only the last one counts.

        Raises:
            UserError: As for :meth:`set_goal`, at once.
        """
        self._asked[GOAL_NAME] = self._checked(goal).tolist()

    def move_object(self, name: str, point: Sequence[float]) -> Frame:
        """Puts a free object to a point (x, y, z) [m], at rest and turned as it is; the episode goes on from there.

        Success is judged at the end of the next step.

        Raises:
            UserError: There is no such object, or the point is not over the table.
        """
        with self._lock:
            self._observe(move_object(self.arm, name, point))
            self._touching = False
            frame = self._frame()
        return self._tell(frame)

    def ask_object(self, name: str, point: Sequence[float]) -> None:
        """:meth:`move_object` by the thread, as soon as it can; of several points only the last one counts.

        Raises:
            UserError: As for :meth:`move_object`, at once.
        """
        self._asked[name] = point_over_table(self.arm, name, point)

    def set_policy(self, name: str) -> Frame:
        """From the next step on, ``name`` acts; what another one remembered is dropped.

        Raises:
            UserError: There is no such policy.
        """
        self._check_policy(name)
        with self._lock:
            self._policy = name
            self._forget()
            frame = self._frame()
        return self._tell(frame)

    def set_planner(self, **changes: float) -> None:
        """Rebuilds the planner with other settings; its present plan is dropped.

        Raises:
            UserError: There is no planner, a value is outside of its slider, a decision would take longer than
                `BUDGET`, or the planner refuses the values; the present one stays.
        """
        with self._lock:
            if self.planner is None:
                raise UserError("this session has no planner; give a checkpoint")
            other = retuned(self.planner, changes, seconds=self._planning_time, budget=BUDGET)
            setattr(policy := self.policies["planner"], place_of(policy), other)
            self._forget()

    @torch.no_grad()
    def _planning_time(self, decisions: int = 3) -> float:
        """Shortest of a few decisions of the present planner [s]: the first may still allocate or compile."""
        times = []
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            for _ in range(decisions):
                self._synchronize()
                began = time.perf_counter()
                self.policies["planner"](self._now.clone())
                self._synchronize()
                times.append(time.perf_counter() - began)
        return min(times)

    # -- what is so --------------------------------------------------------------------------------------

    @property
    def policy(self) -> str:
        """Who acts."""
        return self._policy

    @property
    def planner(self) -> Any:
        """The planner, or tree search, behind the policy ``planner``; None where there is none."""
        return getattr(policy := self.policies.get("planner"), place_of(policy), None)

    @property
    def settings(self) -> list[Setting]:
        """The planner's settings that can be moved."""
        return planner_settings(self.planner)

    @property
    def objects(self) -> tuple[str, ...]:
        """Names of what :meth:`move_object` moves."""
        return free_objects(self.arm)

    @property
    def playing(self) -> bool:
        return self._playing.is_set()

    @property
    def speed(self) -> float:
        """Share of the environment's own rate, within `SPEEDS`.

        Raises:
            UserError: Set to anything else.
        """
        return self._speed

    @speed.setter
    def speed(self, value: float) -> None:
        if not SPEEDS[0] <= value <= SPEEDS[1]:  # NaN is not, either
            raise UserError(f"speed={value}: must be from {SPEEDS[0]:g} to {SPEEDS[1]:g}")
        self._speed = float(value)

    @property
    def period(self) -> float:
        """Time from step to step at the present speed [s]."""
        return 1.0 / (self.arm.config.fps * self.speed)

    @property
    def goal(self) -> np.ndarray:
        """(3,) [m]."""
        with self._lock:
            return _host(self.arm.goal[0])

    def frame(self) -> Frame:
        """What there is to see now."""
        with self._lock:
            return self._frame()

    def listen(self, listener: Callable[[Frame], None]) -> None:
        """Calls ``listener`` with every frame, in the thread that made it."""
        self._listeners.append(listener)

    # -- recording ---------------------------------------------------------------------------------------

    @property
    def recording(self) -> bool:
        return self._recorder is not None

    def start_recording(self, kind: str = "video", **options: Any) -> None:
        """Records every step from now on; what was recorded before and not written is dropped.

        Args:
            kind: ``video`` or ``dataset``.
            options: Those of :class:`VideoRecorder` or :class:`DatasetRecorder`.

        Raises:
            UserError: The environment observes something that has no place in a dataset.
        """
        with self._lock:
            if kind == "dataset":
                self._recorder = DatasetRecorder(self.env, seed=self.seed, policy=self._policy, **options)
            else:
                self._recorder = VideoRecorder(self.arm, **options)

    def stop_recording(self, path: str | Path) -> Path:
        """Writes what was recorded since :meth:`start_recording`: an .mp4, or a dataset's folder.

        Where it cannot be written it is kept, and grows no more: call this again with another path, or
        :meth:`start_recording` to give it up.

        Raises:
            UserError: Nothing was recorded, or the file cannot be written.
        """
        with self._writing:  # who asks a second time meanwhile waits, and finds it written
            with self._lock:
                recorder = self._recorder
                if recorder is None:
                    raise UserError("nothing is being recorded")
                recorder.close()
                if not len(recorder):
                    self._recorder = None  # there is nothing to keep
            written = recorder.write(path)
            with self._lock:
                if self._recorder is recorder:
                    self._recorder = None
            return written

    # -- the thread --------------------------------------------------------------------------------------

    def play(self) -> None:
        self._playing.set()

    def pause(self) -> None:
        self._playing.clear()

    def start(self) -> None:
        """Starts the thread; it steps while :attr:`playing`.

        An exception in it ends the playing and stays in :attr:`error`, which whoever waits must look at.
        """
        if self._thread is None:
            self._stopping.clear()
            self._thread = threading.Thread(target=self._run, name="franka-live", daemon=True)
            self._thread.start()

    def stop(self, timeout: float | None = None) -> bool:
        """Ends the thread, after the step that it is in.

        Args:
            timeout: How long to wait for that step [s]; for ever if None.

        Returns:
            Whether it ended in time; otherwise it ends by itself after the step.
        """
        self._stopping.set()
        thread, self._thread = self._thread, None
        if thread is None or thread is threading.current_thread():
            return True
        thread.join(timeout)
        return not thread.is_alive()

    def _run(self) -> None:
        due = time.perf_counter()
        try:
            while not self._stopping.is_set():
                for what in list(self._asked):
                    point = self._asked.pop(what)
                    self.set_goal(point) if what == GOAL_NAME else self.move_object(what, point)
                if not self._playing.wait(timeout=0.03):
                    due = time.perf_counter()
                    continue
                self.step()
                # What could not be kept up with is not made up for. A thread that waits for the lock gets it
                # only if this one lets go for a moment.
                due = max(due + self.period, time.perf_counter() + 0.001)
                self._stopping.wait(due - time.perf_counter())
        except Exception as error:
            self.error = error
            self._playing.clear()

    # -- parts -------------------------------------------------------------------------------------------

    def _checked(self, goal: Sequence[float]) -> torch.Tensor:
        """(3,) on the environment's device."""
        point = torch.tensor([float(x) for x in goal], dtype=torch.float32)
        if point.shape != (3,) or not bool((point.abs() <= FARTHEST).all()):  # NaN is not, either
            raise UserError(f"goal {tuple(goal)}: must be three numbers, none beyond ±{FARTHEST:g} m")
        point[2].clamp_(min=self.arm.simulation.task.lowest_goal)  # one that is dragged lower stays there
        return point.to(self.arm.device)

    def _check_policy(self, name: str) -> None:
        refuse_old_name("policy", name)
        if name not in self.policies:
            given = name in ("planner", "policy", "expert")
            hint = "; that one needs a checkpoint of a family, or a task, that has it" if given else ""
            raise UserError(f"policy={name!r}: choose from {', '.join(self.policies)}{hint}")

    def _begin_episode(self) -> None:
        self._episode += 1
        self._path, self._touching = None, False
        if self.keep_goal and self._pinned is not None:
            self._place_goal(self._pinned)
        else:
            self._pinned = None

    def _place_goal(self, goal: torch.Tensor) -> None:
        self._observe(self.arm.set_goal(goal))

    def _observe(self, observed: TensorDictBase) -> None:
        """Takes what the arm observes after something was set by hand."""
        for key in self.arm.observation_spec:
            if key not in ("is_init", "success"):
                self._now.set(key, observed[key])

    def _forget(self) -> None:
        """Drops what policies carry from step to step: plans and contexts."""
        self._now = self._now.select(*self._observed)
        self._path = None

    def _synchronize(self) -> None:
        if self.arm.device.type == "cuda":
            torch.cuda.synchronize(self.arm.device)

    def _frame(self, *, stepped: bool = False) -> Frame:
        return Frame(
            steps=self._steps,
            episode=self._episode,
            stepped=stepped,
            policy=self._policy,
            bodies=_host(self.arm.simulation.tensors.body_q[0]),
            tool=_host(self.arm.tool_position()[0]),
            goal=_host(self.arm.goal[0]),
            path=None if self._path is None else _host(self._path[0]),
            reward=self._reward,
            distance=self._distance,
            success=self._success,
            decision=self._decision,
            contacts=touching(self.arm) if self.show_contacts and self._touching else None,
            recording=None if self._recorder is None else len(self._recorder),
            recording_full=self._recorder is not None and self._recorder.full,
        )

    def _tell(self, frame: Frame) -> Frame:
        for listener in self._listeners:
            listener(frame)
        return frame


def _host(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy().copy()
