"""Closed-loop evaluation: whole episodes, on seeds that training never saw, of any policy."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from franka_wm.envs import Environment, FrankaEnv, MultiTaskEnv
from franka_wm.envs.transformed import arm_of
from franka_wm.errors import UserError
from franka_wm.evaluation.intervals import bootstrap_mean, wilson

THRESHOLDS = (0.05, 0.025, 0.01)
"""Distances to the goal that count as success [m]."""

Policy = Callable[[TensorDictBase], TensorDictBase]


def success_distance(env: Environment) -> float | None:
    """Distance to the goal that counts as success [m]; ``None`` where success is no distance, or not of the arm."""
    arm = arm_of(env)
    return (
        None if arm is None or not arm.simulation.task.goal_distance else arm.simulation.task.success_distance
    )


def begin(env: Environment, seed: int, first_world: int | None = None) -> TensorDictBase:
    """The first observations of the episodes that ``seed`` names; the same whenever it is asked for.

    Args:
        first_world: The worlds get the episodes of those from this number; if not given, they keep their numbers.
    """
    arm = arm_of(env)
    if first_world is not None:
        numbered: Any = env if arm is None else arm.simulation
        numbered.set_first_world(first_world)
    if arm is not None:
        return env.reset(seed=seed)
    env.set_seed(seed)
    return env.reset()


@contextmanager
def evaluating(acting: object) -> Iterator[None]:
    """A model, or a policy and the model behind it, in evaluation mode; afterwards every part is in its own again.

    Families may act differently in training mode: TD-MPC2 plans by two Q-functions drawn at random. What is evaluated
    is one agent, whoever asks: the end of a run, the curves, the film, ``franka-wm evaluate``.
    """
    parts = acting.modules() if isinstance(acting, nn.Module) else ()
    modes = [(part, part.training) for part in parts]
    for part, _ in modes:
        part.training = False
    try:
        yield
    finally:
        for part, training in modes:
            part.training = training


@torch.no_grad()
def play_episodes(
    env: Environment,
    policy: Policy,
    *,
    seed: int,
    episodes: int | None = None,
    first_world: int | None = None,
    video: Callable[[], None] | None = None,
) -> TensorDict:
    """Plays one episode in every world and records how it went.

    Args:
        env: Its number of worlds is the number of episodes.
        policy: Run without exploration, its model in evaluation mode.
        seed: Seed of the episodes' poses and goals.
        episodes: Fewer than there are worlds: the first ones. Nothing is decided for the others.
        first_world: As for :func:`begin`.
        video: Called before every step of these episodes, to take an image, until the longest has ended; what is
            simulated after that are others.

    Returns:
        Batch size (N,), or (episodes,), all float32, of each world's first episode up to its true last observation.
        ``return`` and ``length`` of any environment. Of the arm, in one task or several, ``cut_short``, 0 or 1: the
        simulator ended it, since the world was no longer finite or lost contacts; such an episode is no success. Of
        several tasks at once also ``success``, ``success_once``, and ``task_success`` by task, NaN in the worlds of
        others. Of the arm also:

        * ``success`` at the end and ``success_once`` at any step, as the task judges, 0 or 1;
        * ``final_distance`` and ``closest_distance``, tool to goal [m], where the task is to be near the goal;
        * ``measures``, by name, at the end: the task's own (:meth:`~franka_wm.envs.tasks.Task.measures`);
        * ``path_length`` of the tool [m];
        * ``action_change``: mean over steps and components of the squared change of the action as commanded (before
          what ``randomization`` does to it), in units of the action;
        * ``jerk``: root mean square of the tool's third difference × fps³ [m/s³]; 0 for episodes of under three steps.
    """
    n, device = env.num_envs, env.device
    arm = arm_of(env)
    motion: _Motion | _Tasks | None = None if arm is None else _Motion(arm)
    if isinstance(env, MultiTaskEnv):
        motion = _Tasks(env)
    total, length = torch.zeros(n, device=device), torch.zeros(n, device=device)
    running = torch.ones(n, dtype=torch.bool, device=device)
    count = n if episodes is None else min(episodes, n)
    running[count:] = False
    tensordict = begin(env, seed, first_world)
    if motion is not None:
        motion.start()
    with evaluating(policy), set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(env.config.episode_length):
            if video is not None and bool(running.any()):
                video()
            decided = policy(tensordict) if count == n else _decide_for_some(policy, tensordict, count)
            tensordict, following = env.step_and_maybe_reset(decided)
            after = tensordict.get("next")
            # Not a product: what a world does after its first episode, not finite perhaps, does not count.
            total += torch.where(running, after.get("reward").squeeze(-1), 0.0)
            length += running
            if motion is not None:
                motion.see(running, after)
            running &= ~after.get("done").squeeze(-1)
            tensordict = following
            if motion is None and not bool(
                running.any()
            ):  # lives on the host: nothing waits for a device here
                break
    out = {"return": total, "length": length}
    played = TensorDict(out if motion is None else motion.summary(length) | out, batch_size=[n])
    return cast(TensorDict, played[:count])


def _decide_for_some(policy: Policy, tensordict: TensorDictBase, count: int) -> TensorDictBase:
    """What the policy writes for the first ``count`` worlds, zeros for the others, which cost it nothing."""
    decided = policy(cast(TensorDictBase, tensordict[:count]))
    for key in getattr(policy, "out_keys", ["action"]):
        some = decided.get(key)
        every = some.new_zeros(tensordict.batch_size[0], *some.shape[1:])
        every[:count] = some
        tensordict.set(key, every)
    return tensordict


class _Tasks:
    """How each task judges its own worlds' first episodes, where worlds have several tasks."""

    def __init__(self, env: MultiTaskEnv):
        self.envs, self.one_hot = env.envs, env.one_hot.bool()
        self.success, self.once, self.cut = torch.zeros(3, env.num_envs, dtype=torch.bool, device=env.device)

    def start(self) -> None: ...

    def see(self, running: Tensor, after: TensorDictBase) -> None:
        """After a step; ``running`` are the worlds whose first episode it belongs to."""
        succeeds = after.get("success").squeeze(-1)
        self.success = torch.where(running, succeeds, self.success)
        self.once |= running & succeeds
        for k, env in enumerate(self.envs.values()):
            self.cut[k :: len(self.envs)] |= running[k :: len(self.envs)] & _cut_short(env)

    def summary(self, length: Tensor) -> dict[str, Any]:
        own = {
            name: torch.where(self.one_hot[:, k], self.success.float(), torch.nan)
            for k, name in enumerate(self.envs)
        }
        return {
            "success": self.success.float(),
            "success_once": (self.once & ~self.cut).float(),
            "cut_short": self.cut.float(),
            "task_success": own,
        }


def _cut_short(arm: FrankaEnv) -> Tensor:
    """(N,) bool: worlds whose last step was not finite, or lost contacts."""
    arrays = arm.simulation.tensors
    return arrays.broken | (arrays.overflow != 0)


class _Motion:
    """What the tool and the actions do over each world's first episode, and what the task says about it."""

    def __init__(self, arm: FrankaEnv):
        n, device = arm.num_envs, arm.device
        self.arm, self.task = arm, arm.simulation.task
        self.distance, self.path, self.change, self.jerk = torch.zeros(4, n, device=device)
        self.closest = torch.full((n,), torch.inf, device=device)
        self.success, self.once, self.cut = torch.zeros(3, n, dtype=torch.bool, device=device)
        self.measures: dict[str, Tensor] = {}

    def start(self) -> None:
        """After the reset."""
        self._tools = [self.arm.simulation.tensors.true_state[:, 14:17].clone()]
        self._action: Tensor | None = None

    def see(self, running: Tensor, after: TensorDictBase) -> None:
        """After a step; ``running`` are the worlds whose first episode it belongs to."""
        sim = self.arm.simulation
        reached = sim.tensors.next_true_state[:, 17:20].norm(dim=-1)
        self.distance = torch.where(running, reached, self.distance)
        self.closest = torch.where(running, torch.minimum(reached, self.closest), self.closest)
        succeeds = after.get("success").squeeze(-1)
        self.success = torch.where(running, succeeds, self.success)
        self.once |= running & succeeds
        self.cut |= running & _cut_short(self.arm)
        found: object = self.task.measures(sim)
        if not isinstance(found, Mapping):
            raise UserError(
                f"{type(self.task).__name__}.measures gave {type(found).__name__}; it must give a dictionary, "
                f"such as {{'height [m]': a tensor ({len(running)},)}}"
            )
        for name, value in found.items():
            if not isinstance(value, Tensor) or value.shape != running.shape:
                given = tuple(value.shape) if isinstance(value, Tensor) else repr(value)
                raise UserError(
                    f"{type(self.task).__name__}.measures gave {name!r} as {given}; it must be a tensor "
                    f"({len(running)},), one number for each world"
                )
            self.measures[name] = torch.where(running, value.float(), self.measures.get(name, 0.0))
        self._tools = [*self._tools[-3:], sim.tensors.next_true_state[:, 14:17].clone()]
        self.path += torch.where(running, (self._tools[-1] - self._tools[-2]).norm(dim=-1), 0.0)
        if len(self._tools) == 4:
            a, b, c, d = self._tools
            self.jerk += torch.where(running, (d - 3 * c + 3 * b - a).square().sum(-1), 0.0)
        action = sim.tensors.action.clone()
        if self._action is not None:
            self.change += torch.where(running, (action - self._action).square().mean(-1), 0.0)
        self._action = action

    def summary(self, length: Tensor) -> dict[str, Any]:
        changes, thirds = (length - 1).clamp_min(1), (length - 2).clamp_min(1)
        near = {"final_distance": self.distance, "closest_distance": self.closest}
        return {
            **(near if self.task.goal_distance else {}),
            "success": self.success.float(),
            "success_once": (self.once & ~self.cut).float(),
            "cut_short": self.cut.float(),
            **({"measures": self.measures} if self.measures else {}),
            "path_length": self.path,
            "action_change": self.change / changes,
            "jerk": (self.jerk / thirds).sqrt() * self.arm.config.fps**3,
        }


def summarize(episodes: TensorDictBase, *, thresholds: Sequence[float] = THRESHOLDS) -> dict[str, object]:
    """Means with 95 % intervals: bootstrap for distances, returns and motion, Wilson for rates of success.

    Args:
        episodes: As :func:`play_episodes` gives them, or some of their entries.
        thresholds: Distances that count as success [m]; none where the task judges otherwise.

    Returns:
        What there is: ``final_distance`` [m]; ``success`` at the end and ``success_once`` at any step, by threshold
        where there are distances and thresholds, else one rate each, as the task judges; ``task_success`` by task;
        ``return``; ``measures`` of the task's own, by name, over the episodes where they are not NaN;
        ``path_length``, ``action_change``, ``jerk``, ``length``, each with its interval; ``episodes``, the count; and,
        where there are any, how many were ``cut_short``, near the goal or not: none of these is a success.

    Raises:
        UserError: A return is not finite, or a measure infinite.
    """
    present = {str(name): episodes.get(name).cpu() for name in episodes.keys()}  # noqa: SIM118
    count = episodes.numel()
    cut = present.get("cut_short", torch.zeros(count)).bool()

    def mean(name: str, values: Tensor, whose: str) -> dict[str, Any]:
        if odd := int((~values.isfinite()).sum()):
            raise UserError(f"{name}: not finite in {odd} of {count} episodes; mend the task's {whose}")
        return bootstrap_mean(values).as_dict()

    def means(*names: str) -> dict[str, Any]:
        return {name: bootstrap_mean(present[name]).as_dict() for name in names if name in present}

    def rates(name: str, distance: str) -> dict[str, Any]:
        if thresholds and distance in present:
            within = {f"{t:g}": int(((present[distance] < t) & ~cut).sum()) for t in thresholds}
            return {name: {t: wilson(hits, count).as_dict() for t, hits in within.items()}}
        return {name: wilson(int(present[name].sum()), count).as_dict()} if name in present else {}

    own = present.get("measures", {})
    own = {str(name): own[name][~own[name].isnan()] for name in own.keys()}  # noqa: SIM118
    own = {name: mean(name, values, "measures") for name, values in own.items() if len(values)}
    tasks = present.get("task_success", {})
    tasks = {str(name): tasks[name][~tasks[name].isnan()] for name in tasks.keys()}  # noqa: SIM118
    tasks = {name: wilson(int(x.sum()), len(x)).as_dict() for name, x in tasks.items() if len(x)}
    return {
        **means("final_distance"),
        **rates("success", "final_distance"),
        **({"task_success": tasks} if tasks else {}),
        **rates("success_once", "closest_distance"),
        **({"return": mean("return", present["return"], "reward")} if "return" in present else {}),
        **({"measures": own} if own else {}),
        **means("path_length", "action_change", "jerk", "length"),
        "episodes": count,
        **({"cut_short": int(cut.sum())} if bool(cut.any()) else {}),
    }


@torch.no_grad()
def decision_times(
    env: Environment, policy: Policy, *, seed: int = 0, decisions: int = 20, warm_up: int = 3
) -> Tensor:
    """How long a policy takes to decide for all worlds of the environment at once.

    The device is waited for before and after each decision; the environment's own step is not counted.

    Args:
        seed: Seed of the episodes.
        decisions: How many to measure.
        warm_up: How many before that, not measured.

    Returns:
        (decisions,) float64 [s]; take the median, the first may still compile or allocate.
    """

    def wait() -> None:
        if env.device.type == "cuda":
            torch.cuda.synchronize(env.device)

    tensordict = begin(env, seed)
    times = []
    with evaluating(policy), set_exploration_type(ExplorationType.DETERMINISTIC):
        for k in range(warm_up + decisions):
            wait()
            started = time.perf_counter()
            tensordict = policy(tensordict)
            wait()
            if k >= warm_up:
                times.append(time.perf_counter() - started)
            tensordict = env.step_and_maybe_reset(tensordict)[1]
    return torch.tensor(times, dtype=torch.float64)
