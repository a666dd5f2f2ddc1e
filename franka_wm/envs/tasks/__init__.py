"""What is asked of the arm: goal, reward, success. One file for each task.

A task is a subclass of :class:`Task`, which launches Warp kernels, or of :class:`TorchTask`, which has functions of
batched tensors; ``docs/tasks.md`` walks through both. :func:`register` gives it a name.
"""

from franka_wm.envs.config import TASKS, FrankaConfig
from franka_wm.envs.tasks.base import Task
from franka_wm.envs.tasks.reach import Reach, goal_distance, reach_reward
from franka_wm.envs.tasks.torch_task import TorchTask
from franka_wm.envs.tasks.track import Track

__all__ = ["Reach", "Task", "TorchTask", "Track", "goal_distance", "make_task", "reach_reward", "register"]

_REGISTERED: dict[str, type[Task]] = {}


def make_task(config: FrankaConfig) -> Task:
    """The task that ``config.task`` names."""
    return ({"reach": Reach, "track": Track} | _REGISTERED)[config.task](config)


def register(name: str, task: type[Task]) -> None:
    """Makes a task of one's own known, for this process: ``env.task=NAME``.

    Args:
        name: What ``FrankaConfig.task`` will say.
        task: Built with the config alone.
    """
    _REGISTERED[name] = task
    if name not in TASKS:
        TASKS.append(name)
