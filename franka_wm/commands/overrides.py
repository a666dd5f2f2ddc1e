"""Overrides of the configuration, ``group=choice`` and ``key=value``: composed, and in one line when they are wrong."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from franka_wm import conf
from franka_wm.conf import wrong
from franka_wm.errors import UserError


def compose(overrides: Sequence[str], options: Sequence[str] = ()) -> Any:
    """The configuration of ``conf/`` with Hydra's overrides, as ``train.py`` would see it.

    Raises:
        UserError: One line, for an override that Hydra refuses.
    """
    try:
        return conf.compose_or_raise(*overrides)
    except UserError:
        raise
    except wrong.refusals() as error:
        unknown = wrong.unknown_key(wrong.whole(error)) or ""
        if unknown.startswith(OF_TASK) and (told := _of_task(unknown, overrides)) is not None:
            raise UserError(told) from error
        raise UserError(wrong.said_of(error, overrides, conf.compose_or_raise, options)) from error


def given(overrides: Sequence[str], key: str) -> str | None:
    """The text that an override gives to ``key``, without quotes; ``None`` where there is none."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.core.override_parser.types import QuotedString

    line = next((one for one in reversed(overrides) if one.lstrip("+").startswith(f"{key}=")), None)
    if line is None:
        return None
    value = OverridesParser.create().parse_override(line).value()
    return value.text if isinstance(value, QuotedString) else str(value)


def values(overrides: Sequence[str], key: str) -> list[str]:
    """The same of a list that a sweep goes through: each of its values."""
    from hydra.core.override_parser.overrides_parser import OverridesParser

    line = next((one for one in reversed(overrides) if one.lstrip("+").startswith(f"{key}=")), None)
    override = None if line is None else OverridesParser.create().parse_override(line)
    if override is None or not override.is_sweep_override():
        return [] if line is None else [str(given([line], key))]
    return [str(given([f"{key}={one}"], key)) for one in override.sweep_string_iterator()]


def unknown_flags(arguments: Sequence[str], unknown: Sequence[str]) -> str:
    """What is wrong with flags that Hydra does not have; of options typed as elsewhere, how they are typed here."""
    flags = [one for one in unknown if one.startswith("-") and not one[1:2].isdigit()]  # -1 is a value
    typed, written = [], []
    for flag in flags:
        name, equals, value = flag.lstrip("-").partition("=")
        following = arguments[arguments.index(flag) + 1 :][:1]
        if not equals and following and _VALUE.fullmatch(following[0]):
            flag, equals, value = f"{flag} {following[0]}", "=", following[0]
        typed += [flag]
        written += [f"{name}={value}"] if equals else []
    if not written:
        return f"unrecognized arguments: {' '.join(flags or unknown)}"
    return f"{' '.join(typed)}: no such flag; options have no dashes, write {' '.join(written)}"


def changes(verb: str, overrides: Sequence[str]) -> dict[str, Any]:
    """``GROUP.KEY=VALUE`` … of a verb as nested dictionaries, values as in YAML.

    Raises:
        UserError: A value that is none.
    """
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException
    from yaml import YAMLError

    try:
        found: Any = OmegaConf.to_container(OmegaConf.from_dotlist(list(overrides)))
    except (YAMLError, OmegaConfBaseException) as error:
        raise UserError(f"{verb}: {' '.join(overrides)}: not a value as in YAML ({error})") from error
    return found


OF_TASK = "env.task_options."
"""What options that a task brings itself begin with."""
_VALUE = re.compile(r"-?[\d.][^=]*|[^-][^=]*")
"""What may follow a flag as its value: no flag, and no override."""


def _of_task(unknown: str, overrides: Sequence[str]) -> str | None:
    """What is wrong with an option of the task that the configuration does not name: only its class knows all.

    ``None`` where there is no such task.
    """
    from franka_wm.envs.task_options import has
    from franka_wm.envs.tasks import TASKS, task_class
    from franka_wm.training.run import import_plugins

    keys = [(o.partition("=")[0], o) for o in overrides]
    cfg = wrong.composed(
        conf.compose_or_raise, *(o for key, o in keys if key == "hydra.searchpath" or "." not in key)
    )
    if cfg is None:
        return None
    import_plugins(cfg.plugins)
    task = given(overrides, "env.task") or cfg.env.get("task")
    if cfg.env.kind != "franka" or task not in TASKS:
        return None
    defaults, name = task_class(task).option_defaults, unknown.removeprefix(OF_TASK)
    there = has(task, defaults)
    if name in defaults:
        value = next((o.partition("=")[2] for key, o in keys if key == unknown), "…")
        return f"{unknown}: the preset does not name it; write +{unknown}={value}; {there}"
    return f"{unknown}: no such option; {there}"


def number(cfg: Any, key: str, kind: type[int] | type[float] = int) -> Any:
    """The number at ``key`` of a configuration.

    Raises:
        UserError: There is something else.
    """
    from omegaconf import OmegaConf

    value = OmegaConf.select(cfg, key)
    if isinstance(value, bool) or not isinstance(value, int if kind is int else int | float):
        raise UserError(f"{key}={value}: must be a {'whole ' if kind is int else ''}number")
    return kind(value)
