"""Options of a run that goes on, as they are typed: its own, which the configuration without it need not have."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf

from franka_wm import conf
from franka_wm.commands.entry import fail
from franka_wm.commands.overrides import compose, values
from franka_wm.errors import FrankaError, UserError
from franka_wm.interrupt import INTERRUPTED
from franka_wm.options import leaves, no_such_option

_OPTION = re.compile(r"([a-z]\w*)(\.\w+)+(?==)")
"""GROUP.KEY of what is typed without + or ~."""
_HELP = {"--help", "-h", "--hydra-help"}


def with_options_of_its_run(arguments: Sequence[str]) -> list[str]:
    """A command line whose ``GROUP.KEY=VALUE`` beside ``resume=RUN`` may be any option of that run.

    Hydra composes its own defaults, of another model or planner: it refuses what those do not have, and takes what the
    run does not have. Of a sweep over runs the option must be one of each.

    Raises:
        SystemExit: The run has no such option, or cannot be read; one line.
    """
    try:
        folders = [] if _HELP & {*arguments} else values(arguments, "resume")
        if not folders or not all(one and Path(one).expanduser().is_dir() for one in folders):  # said later
            return list(arguments)
        from franka_wm.training.checkpoint import latest_checkpoint, load_checkpoint

        configs = [load_checkpoint(latest_checkpoint(one)).config for one in folders]
        configs = [one.get("whole_run") or one for one in configs]  # of a first stage's checkpoint
        return [max((_typed(argument, one) for one in configs), key=len) for argument in arguments]
    except FrankaError as error:
        fail(str(error))
    except (HydraException, OSError):  # said where it is read
        return list(arguments)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


@cache
def _defaults() -> DictConfig:
    """What Hydra composes of no option of a run's own."""
    return compose(["scale=smoke"])


def _typed(argument: str, saved: Mapping[str, Any]) -> str:
    """`argument`, with ++ before an option that the run has and Hydra's defaults do not: so Hydra takes it."""
    found = _OPTION.match(argument)
    group = None if found is None else saved.get(found[1])
    if found is None or not isinstance(group, Mapping) or found[1] not in conf.KNOWN:
        return argument
    parts = found[0].split(".")
    given = argument if _has(_defaults(), parts) else f"++{argument}"
    if _has(saved, parts):
        return given
    if found[1] not in ("model", "planner"):  # of which a default may be another one: elsewhere Hydra knows
        return argument
    # A run that is older than the option: what models or planners of its name have today.
    presets = (conf.compose("scale=smoke", f"{found[1]}={one}") for one in conf.presets(found[1]))
    today = [one for one in presets if one[found[1]].name == group.get("name")]
    if today and not any(_has(one, parts) for one in today):
        raise UserError(no_such_option(found[0], [*leaves(group, found[1])]))
    return given if today else argument


def _has(node: Any, parts: Sequence[str]) -> bool:
    if isinstance(node, DictConfig):  # to which what is null by a resolver is not there
        node = OmegaConf.to_container(node)
    for part in parts:
        if not isinstance(node, Mapping) or part not in node:
            return False
        node = node[part]
    return True
