"""Which tasks share a ``MultiTaskEnv``; read before any simulator is imported."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from franka_wm.envs.config import FrankaConfig
from franka_wm.errors import UserError


@dataclass(frozen=True, kw_only=True)
class MultiTaskConfig:
    """Tasks by name, each with the arm's config.

    Raises:
        UserError: No task, images among the observations, or ``auto_reset="standard"``.
    """

    tasks: Mapping[str, FrankaConfig]
    auto_reset: str = "native"

    def __post_init__(self) -> None:
        if not self.tasks:
            raise UserError("env.tasks is empty: it must name at least one task, as env=multitask does")
        if self.auto_reset != "native":
            raise UserError(f"auto_reset={self.auto_reset}: tasks together need native")
        for name, config in self.tasks.items():
            if config.images:
                raise UserError(
                    f"env.tasks.{name}.observations has {', '.join(config.images)}: several tasks observe vectors alone"
                )
            if config.auto_reset != "native":
                raise UserError(
                    f"env.tasks.{name}.auto_reset={config.auto_reset}: tasks together need native"
                )

    @property
    def episode_length(self) -> int:
        """Steps of the longest episode."""
        return max(config.episode_length for config in self.tasks.values())

    @property
    def terminate_on_success(self) -> bool:
        """Whether any task does."""
        return any(config.terminate_on_success for config in self.tasks.values())


def multi_task_config(values: Mapping[str, Any]) -> MultiTaskConfig:
    """From a plain mapping: ``kind``, and ``tasks`` with a mapping as of ``conf/env`` for each.

    Raises:
        UserError: What a config says of itself, with the task's name.
    """
    unknown = sorted(set(values) - {"kind", "tasks"})
    if unknown:
        raise UserError(
            f"env.{unknown[0]}: no such field; options of one task are env.tasks.NAME.{unknown[0]}"
        )
    tasks = values.get("tasks")
    if not isinstance(tasks, Mapping):
        raise UserError(f"env.tasks={tasks!r}: must be tasks by name, as env=multitask has")
    configs = {}
    for name, one in tasks.items():
        if not isinstance(one, Mapping) or one.get("kind") != "franka" or one.get("urdf_path") is not None:
            raise UserError(f"env.tasks.{name}: must be a preset of the arm, without urdf_path")
        try:
            own = {key: value for key, value in one.items() if key not in ("kind", "urdf_path")}
            configs[str(name)] = FrankaConfig.from_mapping(own)
        except UserError as error:
            raise UserError(f"env.tasks.{name}: {error}") from error
    return MultiTaskConfig(tasks=configs)
