"""Options of the config that only some tasks read, and those that a task brings itself."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from franka_wm.errors import UserError
from franka_wm.options import Rule, is_real, is_whole

if TYPE_CHECKING:
    from franka_wm.envs.config import FrankaConfig

KINDS = {
    bool: Rule(lambda x: isinstance(x, bool), "true or false"),
    int: Rule(is_whole, "a whole number"),
    float: Rule(is_real, "a finite number"),
    str: Rule(lambda x: isinstance(x, str), "text"),
}
"""What an option of a task may be, by the type of its default."""


def check_defaults(owner: str, defaults: Any) -> None:
    """Refuses an ``option_defaults`` that has other than names, each with a value of :data:`KINDS`.

    Raises:
        UserError: One line.
    """
    if not isinstance(defaults, Mapping) or not all(isinstance(name, str) for name in defaults):
        raise UserError(f"{owner}.option_defaults={defaults!r}: must be a mapping, such as {{'radius': 0.5}}")
    for name, value in defaults.items():
        if type(value) not in KINDS or not KINDS[type(value)].fits(value):
            wanted = ", ".join(rule.wanted for rule in KINDS.values())
            raise UserError(f"{owner}.option_defaults: {name} is {value!r}; must be one of: {wanted}")


def has(task: str, defaults: Mapping[str, Any]) -> str:
    """Which options a task brings, in words."""
    listed = ", ".join(f"{name}={typed(value)}" for name, value in defaults.items())
    return f"task={task} has {listed or 'none; leave them out'}"


def task_options(config: FrankaConfig) -> dict[str, Any]:
    """The config's ``task_options``, each of the type of its default.

    Raises:
        UserError: An option that the task does not have, or a value of another type than its default.
    """
    defaults, given = config.task_class.option_defaults, config.task_options
    there = has(config.task, defaults)
    given = {} if given is None else given  # null in a file
    if not isinstance(given, Mapping):
        raise UserError(f"task_options={given!r}: must be a mapping; {there}")
    for name, value in given.items():
        if name not in defaults:
            raise UserError(f"task_options.{name}={typed(value)}: no such option; {there}")
        if not (rule := KINDS[type(defaults[name])]).fits(value):
            raise UserError(f"task_options.{name}={value!r}: must be {rule.wanted}; {there}")
    return {name: type(defaults[name])(value) for name, value in given.items()}


def check_own_options(config: FrankaConfig, owners: Mapping[str, list[str]]) -> None:
    """Refuses options of other tasks: they would do nothing.

    Args:
        config: The arm's.
        owners: Options that not every task reads → the tasks of the package that do.

    Raises:
        UserError: One line.
    """
    for name, tasks in owners.items():
        value, default = getattr(config, name), getattr(type(config), name)
        if value != default and name not in config.task_class.own_options:
            raise UserError(
                f"{name}={value}: task={config.task} does not read it, {', '.join(tasks)} "
                f"do{'es' * (len(tasks) == 1)}; leave it at {typed(default)}"
            )


def typed(value: Any) -> str:
    """A value as one types it in a command."""
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{name}: {typed(one)}' for name, one in value.items())}}}"
    return {"None": "null", "True": "true", "False": "false"}.get(str(value), str(value))
