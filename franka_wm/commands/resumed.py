"""Options of a run that goes on, as they are typed: its own, which the configuration without it need not have."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from franka_wm.commands.entry import fail
from franka_wm.commands.overrides import compose, given
from franka_wm.errors import FrankaError, UserError
from franka_wm.interrupt import INTERRUPTED
from franka_wm.options import leaves, no_such_option

_OPTION = re.compile(r"([a-z]\w*)(\.\w+)+(?==)")
"""GROUP.KEY of what is typed without + or ~."""


def with_options_of_its_run(arguments: Sequence[str]) -> list[str]:
    """A command line whose ``GROUP.KEY=VALUE`` beside ``resume=RUN`` may be any option of that run.

    Hydra composes its own defaults, of another model or planner: it refuses what those do not have, and takes what the
    run does not have.

    Raises:
        SystemExit: The run has no such option, or cannot be read; one line.
    """
    try:
        folder = given([one for one in arguments if one.startswith("resume=")], "resume")
        if not folder or not Path(folder).expanduser().is_dir():  # said later
            return list(arguments)
        from franka_wm.training.checkpoint import latest_checkpoint, load_checkpoint

        saved = load_checkpoint(latest_checkpoint(folder)).config
        saved = saved.get("whole_run") or saved  # of a first stage's checkpoint
        return [_forced(one, saved) for one in arguments]
    except FrankaError as error:
        fail(str(error))
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


def _forced(argument: str, saved: Mapping[str, Any]) -> str:
    """`argument`, with ++ before an option that `saved` has and Hydra's defaults do not: so Hydra takes it."""
    found = _OPTION.match(argument)
    group = saved.get(found[1]) if found is not None else None
    if found is None or not isinstance(group, Mapping):
        return argument
    default, parts = compose(["scale=smoke"]), found[0].split(".")
    if _has(saved, parts):
        return argument if _has(default, parts) else f"++{argument}"
    if all(default[found[1]].get(name) == group.get(name) for name in ("name", "kind")):
        return argument  # an older run, or a typing error: Hydra knows
    raise UserError(no_such_option(found[0], [*leaves(group, found[1])]))


def _has(node: Any, parts: Sequence[str]) -> bool:
    for part in parts:
        if not isinstance(node, Mapping) or part not in node:
            return False
        node = node[part]
    return True
