"""The base class of tasks."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import torch
import warp as wp
from tensordict import TensorDict, TensorDictBase

from franka_wm.envs.constants import NUM_JOINTS
from franka_wm.envs.scene import Scene
from franka_wm.envs.task_options import check_defaults
from franka_wm.errors import UserError
from franka_wm.options import check_whole, is_real

if TYPE_CHECKING:
    from franka_wm.envs.config import FrankaConfig
    from franka_wm.envs.simulation import Simulation
    from franka_wm.envs.tasks.experts import Aim, Sight


class Task:
    """Goal, reward and success of all worlds, in Warp kernels. Override what differs; each method only launches.

    A task in torch instead is a :class:`~franka_wm.envs.tasks.TorchTask`.

    Args:
        config: The environment's.

    Attributes:
        num_draws: How many random numbers, uniform in [0, 1), each episode of each world gets in ``sim.warp.draws``
            before ``reset``. They depend on seed, world and episode alone.
        draws_goals: Whether the task draws its goals itself; then the config's ``goal`` is not among them.
        gripper: Whether the task needs driven fingers.
        scene: What stands around the arm, where the config does not say.
        home: Joint angles at the start [rad], where the config does not say; ``None``: the arm's.
        marker: What ``show_goal`` draws: a disc of this radius on the table [m]; ``None``: a ball at the goal.
        lowest_goal: Where the task keeps its goals at or above this height [m]: so do those set by hand.
        rewards: What ``reward`` may be.
        own_options: Options of the config that the task reads and not every task does; others are refused.
        option_defaults: Options that the task brings itself, by name: numbers, true or false, words.
            ``env.task_options`` changes them, ``self.options`` has them.
        words: The task in words, for datasets.
    """

    num_draws = 0
    draws_goals = False
    gripper = False
    scene: Scene | None = None
    home: tuple[float, ...] | None = None
    marker: float | None = None
    lowest_goal = -math.inf
    rewards: tuple[str, ...] = ("dense", "sparse", "normalized")
    own_options: tuple[str, ...] = ("success_distance",)
    option_defaults: ClassVar[Mapping[str, float | int | bool | str]] = {}
    words = "Do what the reward asks for."

    def __init__(self, config: FrankaConfig):
        self.config = config

    def __init_subclass__(cls, **kwargs) -> None:
        super().__init_subclass__(**kwargs)
        if "judge" in vars(cls):
            raise UserError(f"{cls.__name__}.judge: the method is called reward_and_success now; rename it")
        if "options" in vars(cls):
            raise UserError(f"{cls.__name__}.options: is read; name the defaults option_defaults")
        check_defaults(cls.__name__, cls.option_defaults)
        for name in ("rewards", "own_options"):
            words = getattr(cls, name)
            if not isinstance(words, tuple) or not all(isinstance(word, str) for word in words):
                hint = "; the function is called reward" if callable(words) else ""
                raise UserError(
                    f"{cls.__name__}.{name}={words!r}: must be a tuple of words, such as {getattr(Task, name)}{hint}"
                )
        draws, bounds = vars(cls).get("num_draws", 0), vars(cls).get("reward_bounds")
        if not hasattr(draws, "__get__"):  # a property says it later
            check_whole(f"{cls.__name__}.num_draws", draws, least=0)
        ordered = (
            isinstance(bounds, tuple | list)
            and len(bounds) == 2
            and all(map(is_real, bounds))
            and bounds[0] < bounds[1]
        )
        if not (ordered or bounds is None or hasattr(bounds, "__get__")):
            raise UserError(
                f"{cls.__name__}.reward_bounds={bounds!r}: must be the least and the largest reward of a step, such as "
                "(-1.0, 0.0), or None"
            )
        if cls.scene is not None:
            cls.scene = Scene.of(cls.scene)
        if cls.home is not None and len(cls.home) != NUM_JOINTS:
            raise UserError(
                f"{cls.__name__}.home={cls.home!r}: give {NUM_JOINTS} joint angles [rad], or None"
            )

    @property
    def options(self) -> dict[str, Any]:
        """``option_defaults``, as the config's ``task_options`` changes them."""
        return {**self.option_defaults, **self.config.task_options}

    @options.setter
    def options(self, _: object) -> None:
        raise UserError(f"{type(self).__name__}.options: is read; name the defaults option_defaults")

    @property
    def reward_bounds(self) -> tuple[float, float] | None:
        """Least and largest reward of a step, from which models derive the range of their values.

        ``None``: unknown. A class attribute is enough: ``reward_bounds = (-1.0, 0.0)``.
        """
        return None

    @property
    def goal_distance(self) -> bool:
        """Whether the task is to bring the tool near ``task_goal``.

        Then evaluation reports the distance as well, and a :class:`TorchTask` takes goals in hindsight. A class
        attribute is enough: ``goal_distance = True``.
        """
        return False

    @property
    def success_distance(self) -> float | None:
        """Below which distance of the tool to ``task_goal`` [m] it is a success, where nothing else decides.

        With ``goal_distance`` evaluation then shows success within several distances; else as the task judges. A class
        attribute is enough: ``success_distance = 0.03``.
        """
        return None

    @classmethod
    def check(cls, config: FrankaConfig) -> None:
        """Refuses a config in which the task cannot be played, before anything is built: goals that it draws itself.

        Raises:
            UserError: One line.
        """
        given = {
            "goal": config.goal != type(config).goal,
            "goal_sampling": config.goal_sampling == "fixed",
            "goal_noise": config.goal_noise != type(config).goal_noise,
        }
        for name in given:
            if cls.draws_goals and given[name]:
                label = config.task if config.task_class is cls else cls.__name__
                raise UserError(
                    f"{name}={getattr(config, name)}: task={label} draws its own goals; leave it out (docs/tasks.md)"
                )

    @classmethod
    def must_define(cls) -> list[str]:
        """Methods that a subclass has to define."""
        return ["reset", "reward_and_success"]

    @classmethod
    def check_defined(cls) -> None:
        """Refuses a class that lacks what a task must define.

        Raises:
            UserError: One line.
        """
        names = cls.must_define()
        missing = [name for name in names if getattr(getattr(cls, name), "__isabstractmethod__", False)]
        if missing:
            raise UserError(
                f"{cls.__name__} must define {' and '.join(filter(None, (', '.join(names[:-1]), names[-1])))}; "
                f"{' and '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing"
            )

    @classmethod
    def disc(cls, config: FrankaConfig) -> float | None:
        """Radius of the disc that ``show_goal`` draws [m]: ``marker``, or the config's where the task reads it."""
        return config.disc_radius if "disc_radius" in cls.own_options else cls.marker

    @classmethod
    def check_goal_image(cls) -> None:
        """Refuses ``goal_pixels`` with a gripper where the task does not say what they show.

        Raises:
            UserError: One line.
        """
        if cls.pose_at_goal is None:
            raise UserError(
                f"goal_pixels: {cls.__name__} has no image of its goal; leave it out (show_goal draws it), or write "
                f"{cls.__name__}.pose_at_goal"
            )

    def brings(self) -> dict[str, Any]:
        """Fields of the config that a task given as an object sets, where the config leaves them to the task."""
        config = self.config
        own = {"gripper": self.gripper or None, "scene": self.scene, "home": self.home}
        return {name: value for name, value in own.items() if getattr(config, name) is None}

    @abstractmethod  # said by check_defined: a class without may be made, for what it says alone
    def reset(self, sim: Simulation, mask: wp.array) -> None:
        """Writes ``sim.warp.task_goal`` (N, 3), and ``sim.warp.goal_q`` (N, 7) if known, where ``mask`` (N,)."""
        raise NotImplementedError(f"{type(self).__name__} gives no goal")

    def begin(self, sim: Simulation, mask: wp.array) -> None:
        """Called after a reset, when ``sim.warp.true_state`` (N, 20) is the first one of the masked worlds."""

    def advance(self, sim: Simulation) -> None:
        """Called in every step after the physics and before the observation: moves a goal that moves."""

    def goal_was_set(self, sim: Simulation) -> None:
        """Called when ``sim.tensors.task_goal`` was set by hand: a goal that moves goes on from there. Only torch."""

    @abstractmethod
    def reward_and_success(self, sim: Simulation) -> None:
        """Writes ``sim.warp.reward`` and ``sim.warp.success`` (N, 1) from ``next_true_state`` (N, 20) and ``action``.

        ``next_true_state`` is ``next_state`` without observation noise.
        """
        raise NotImplementedError(f"{type(self).__name__} gives no reward")

    def present_reward(self, sim: Simulation, action: torch.Tensor) -> torch.Tensor:
        """Reward of having applied ``action`` (N, A) and being in the present state, (N, 1).

        Raises:
            UserError: The task has no reward in torch.
        """
        raise UserError(f"{type(self).__name__} has its reward in a kernel; read it from a step")

    def measures(self, sim: Simulation) -> dict[str, torch.Tensor]:
        """What else evaluation reports, by names with their units: (N,) each, after a step; the episode's last counts.

        NaN: it does not apply to this episode, which the mean then leaves out.
        Computed with torch, outside the captured step, from ``sim.tensors.next_true_state`` (N, 20): finished worlds
        have been reset already.
        """
        return {}

    expert: Callable[[Sight], Aim] | None = None
    """Where the hand shall be next, from what is seen (a method in torch, for all worlds at once, without a host sync):
    what makes the task solvable by ``policy=expert``."""

    pose_at_goal: Callable[[Simulation, wp.array], None] | None = None
    """What ``goal_pixels`` show of a task with a gripper: called after ``reset`` where these are observed, and when a
    goal is moved by hand. Writes ``sim.warp.goal_rest``, which has ``rest_q`` of the episode's start, and
    ``sim.warp.goal_q`` (N, 7) where ``mask`` (N,)."""

    relabel: Callable[[TensorDictBase, torch.Tensor], TensorDictBase] | None = None
    """Recorded transitions as if the goal had been another, where the task can say so in torch: see `Reach.relabel`."""

    relabel_reads: tuple[str, ...] = ("state",)
    """Observations that ``relabel`` reads in what an action led to."""

    achieved: tuple[str, slice] = ("state", slice(14, 17))
    """The observation, and its columns (3) [m], of the place that a goal names, where it was reached: the tool's."""

    @classmethod
    def relabels(cls) -> bool:
        """Whether ``relabel`` speaks for this task: a subclass that changes rewards or moves goals says so anew."""

        def owner(name: str) -> int:
            return next(i for i, one in enumerate(cls.__mro__) if name in vars(one))

        return cls.relabel is not None and owner("relabel") <= min(
            owner("reward_and_success"), owner("advance")
        )


def with_goal(transitions: TensorDictBase, goal: torch.Tensor) -> TensorDict:
    """What another goal changes in the observations of recorded transitions; exact where they have no noise.

    Args:
        transitions: (B, H) with ``state`` (20 or 28), also in ``next``.
        goal: (B, 3) [m].

    Returns:
        (B, H): ``state``, and ``goal`` where there is one; the same in ``next``.
    """
    goal = goal.unsqueeze(1).expand(*transitions.batch_size, 3)
    out = TensorDict({}, batch_size=transitions.batch_size)
    for root in ((), ("next",)):
        state = transitions.get((*root, "state"))
        moved = [state[..., :17], state[..., 14:17] - goal, state[..., 20:]]
        out.set((*root, "state"), torch.cat(moved, -1))
        if transitions.get((*root, "goal"), None) is not None:
            out.set((*root, "goal"), goal)
    return out
