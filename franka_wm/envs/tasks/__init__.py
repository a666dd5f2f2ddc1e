"""What is asked of the arm: goal, reward, success. One file for each task.

A task launches Warp kernels, so that it is part of the captured step; :class:`Task` says when. The pure tensor
functions of a task say the same in torch, for users and for the tests. To add one: a subclass, made
known by :func:`register`; ``docs/tasks.md`` walks through an example.
"""

from __future__ import annotations

from franka_wm.envs.config import TASKS, FrankaConfig
from franka_wm.envs.tasks._base import Task
from franka_wm.envs.tasks.reach import Reach, goal_distance, reach_reward
from franka_wm.envs.tasks.track import Track

__all__ = ["Reach", "Task", "Track", "goal_distance", "make_task", "reach_reward", "register"]


def make_task(config: FrankaConfig) -> Task:
    """The task that ``config.task`` names."""
    return ({"reach": Reach, "track": Track} | _REGISTERED)[config.task](config)


_REGISTERED: dict[str, type[Task]] = {}


def register(name: str, task: type[Task]) -> None:
    """Makes a task of one's own known, for this process: ``env.task=NAME``.

    Args:
        name: What ``FrankaConfig.task`` will say.
        task: Built with the config alone.
    """
    _REGISTERED[name] = task
    if name not in TASKS:
        TASKS.append(name)
