"""Overrides of the configuration, ``group=choice`` and ``key=value``: composed, and in one line when they are wrong."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from franka_wm import conf
from franka_wm.commands.arguments import did_you_mean, no_such_option
from franka_wm.errors import UserError
from franka_wm.options import preset_of_ones_own


def compose(overrides: Sequence[str], options: Sequence[str] = ()) -> Any:
    """The configuration of ``conf/`` with Hydra's overrides, as ``train.py`` would see it.

    Raises:
        UserError: One line, for an override that Hydra refuses.
    """
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    try:
        return conf.compose(*overrides)
    except UserError:
        raise
    # The last three for a group that is no name, or too long for one.
    except (HydraException, OmegaConfBaseException, ValueError, TypeError, OSError) as error:
        said = str(error)
        if _UNKNOWN.search(said):  # of a mapping, the cause names the key inside it
            said = f"{said}\n{error.__cause__}"
        unknown = _unknown_key(said) or ""
        if unknown.startswith(OF_TASK) and (told := _of_task(unknown, overrides)) is not None:
            raise UserError(told) from error
        raise UserError(explain(said, allowed=_allowed(said, overrides, options))) from error


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


EXTRAS = {
    "joblib": "joblib",
    "submitit_slurm": "slurm",
    "submitit_local": "slurm",
    "ray": "ray",
    "optuna": "optuna",
}
"""Launchers and sweepers of ``--multirun``, and the extra of this package that has each."""
OF_TASK = "env.task_options."
"""What options that a task brings itself begin with."""
_VALUE = re.compile(r"-?[\d.][^=]*|[^-][^=]*")
"""What may follow a flag as its value: no flag, and no override."""
_MISSING = re.compile(r"Could not find '([^']+)/([^'/]+)'")
_UNKNOWN = re.compile(r"Could not override '([^']+)'")


def explain(message: str, *, allowed: Sequence[str] = ()) -> str:
    """What Hydra and OmegaConf say of an override, in one line.

    Args:
        message: Theirs, of many lines: with the choices of a group, how to append, where configurations are.
        allowed: Keys that there are in the place of an unknown one.
    """
    lines = [line.strip() for line in message.splitlines() if line.strip()]
    missing, unknown = _MISSING.search(message), _unknown_key(message)
    if missing is not None:
        choices = [line for line in message.splitlines() if line.startswith("\t") and "provider=" not in line]
        names = [line.strip() for line in choices]
        extra = EXTRAS.get(missing[2]) if missing[1].startswith("hydra/") else None
        near = did_you_mean(missing[2], names) or preset_of_ones_own(missing[1], missing[2])
        hint = f"; pip install 'franka-wm[{extra}]'" if extra else near
        return f"{missing[1]}={missing[2]}: must be one of {', '.join(names)}{hint}"
    if unknown is not None:
        return no_such_option(unknown, allowed)
    noise = ("full_key:", "object_type", "Config search path", "provider=", "See https://", "Set the env")
    return "; ".join(line for line in lines if not line.startswith(noise))


def _unknown_key(message: str) -> str | None:
    """The key that an override names in vain; of one that sets a mapping, the key inside it."""
    unknown, full = _UNKNOWN.search(message), re.search(r"full_key: (\S+)", message)
    if unknown is None:
        return None
    return full[1] if full is not None and full[1].startswith(f"{unknown[1]}.") else unknown[1]


def _composed(*overrides: str) -> Any:
    """The configuration of some overrides; ``None`` where one of these is wrong, too."""
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    try:
        return conf.compose(*overrides)
    except (HydraException, OmegaConfBaseException, UserError):
        return None


def _of_task(unknown: str, overrides: Sequence[str]) -> str | None:
    """What is wrong with an option of the task that the configuration does not name: only its class knows all.

    ``None`` where there is no such task.
    """
    from franka_wm.envs.task_options import has
    from franka_wm.envs.tasks import TASKS, task_class
    from franka_wm.training.run import import_plugins

    keys = [(o.partition("=")[0], o) for o in overrides]
    cfg = _composed(*(o for key, o in keys if key == "hydra.searchpath" or "." not in key))
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


def _allowed(message: str, overrides: Sequence[str], options: Sequence[str]) -> list[str]:
    """The keys besides the one that an override names in vain; at the top, the verb's own, too."""
    from omegaconf import DictConfig, OmegaConf

    unknown = _unknown_key(message)
    if unknown is None:
        return []
    # With the same choices of groups, and where they are looked for: other environments have other options.
    keys = [(o.partition("=")[0], o) for o in overrides]
    chosen = [o for key, o in keys if key == "hydra.searchpath" or ("." not in key and key != unknown)]
    node = _composed(*chosen)
    if node is None:
        return []
    place = unknown.rpartition(".")[0] if "/" not in unknown and "@" not in unknown else ""
    found = OmegaConf.select(node, place) if place else node
    if isinstance(found, DictConfig):
        return [
            f"{place}.{key}" if place else str(key)
            for key in dict.fromkeys([*([] if place else options), *found])
        ]
    above, _, name = place.rpartition(".")
    if name in (OmegaConf.select(node, above) or ()):  # null here: it is given whole
        return [place]
    return [*options, *(str(key) for key in node)]


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
