"""What is asked of the arm: goal, reward, success. One file for each task.

A task is a subclass of :class:`Task`, which launches Warp kernels, or of :class:`TorchTask`, which has functions of
batched tensors; ``docs/tasks.md`` walks through both. :func:`register` gives it a name.
"""

from __future__ import annotations

from inspect import signature
from typing import TYPE_CHECKING

from franka_wm.envs.tasks.base import Task
from franka_wm.envs.tasks.drawer import Drawer
from franka_wm.envs.tasks.lift import Lift
from franka_wm.envs.tasks.peg import Peg
from franka_wm.envs.tasks.pick import Pick
from franka_wm.envs.tasks.push import Push
from franka_wm.envs.tasks.reach import Reach, goal_distance, reach_reward
from franka_wm.envs.tasks.stack import Stack
from franka_wm.envs.tasks.torch_task import TorchTask
from franka_wm.envs.tasks.track import Track
from franka_wm.errors import UserError
from franka_wm.options import refuse_ours

if TYPE_CHECKING:
    from franka_wm.envs.config import FrankaConfig

__all__ = [
    "Drawer",
    "Lift",
    "Peg",
    "Pick",
    "Push",
    "Reach",
    "Stack",
    "Task",
    "TorchTask",
    "Track",
    "goal_distance",
    "make_task",
    "reach_reward",
    "register",
    "task_class",
]

_BUILT_IN: dict[str, type[Task]] = {
    "reach": Reach,
    "track": Track,
    "lift": Lift,
    "push": Push,
    "pick": Pick,
    "stack": Stack,
    "drawer": Drawer,
    "peg": Peg,
}

_REGISTERED: dict[str, type[Task]] = {}

TASKS = list(_BUILT_IN)
"""What ``task`` may be; :func:`register` adds to it."""


def task_class(name: str) -> type[Task]:
    """The class that a name stands for."""
    return _REGISTERED[name] if name in _REGISTERED else _BUILT_IN[name]


def own_options() -> dict[str, list[str]]:
    """Options of the config that not every task reads, and the tasks that do, of those that ship with the package."""
    names = dict.fromkeys(name for task in _BUILT_IN.values() for name in task.own_options)
    return {name: [one for one, task in _BUILT_IN.items() if name in task.own_options] for name in names}


def make_task(config: FrankaConfig) -> Task:
    """The task that ``config.task`` names."""
    return task_class(config.task)(config)


def register(name: str, task: type[Task]) -> None:
    """Makes a task of one's own known, for this process: ``env.task=NAME``. The last of a name counts.

    Args:
        name: What ``FrankaConfig.task`` will say.
        task: Built with the config alone.

    Raises:
        UserError: It is not a subclass of :class:`Task`, lacks what a task must define, cannot be built with the
            config alone, or has other ``own_options`` than those that tasks of the package read; or the package has
            the name.
    """
    if not (isinstance(task, type) and issubclass(task, Task)):
        raise UserError(f"register({name!r}, {task!r}): must be a class, a subclass of Task or TorchTask")
    refuse_ours(name, _BUILT_IN)
    task.check_defined()
    try:
        signature(task).bind("config")
    except TypeError as error:
        raise UserError(
            f"register({name!r}, {task.__name__}): {task.__name__}(config) builds it, and its constructor asks for "
            f"other arguments ({error}); give those a default"
        ) from error
    for option in task.own_options:
        if option not in (known := own_options()):
            raise UserError(
                f"{task.__name__}.own_options: {option} is none of {', '.join(known)}; what else the config has needs "
                f"no naming; what the task brings has its default in {task.__name__}.option_defaults, and "
                f"'env.task_options={{{option}: …}}' sets it"
            )
    _REGISTERED[name] = task
    if name not in TASKS:
        TASKS.append(name)
