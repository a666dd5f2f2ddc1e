"""What the verbs that deal with datasets share: ``key=value`` arguments, and the configuration that the rest names."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from franka_wm import conf
from franka_wm.errors import UserError

CHECKOUT = Path(__file__).parents[2]
"""Top of the repository, where ``benchmarks`` is, if the package runs from one."""


def split(
    verb: str, arguments: Sequence[str], known: Mapping[str, Any], *, more: bool = False
) -> tuple[dict[str, Any], list[str]]:
    """Arguments as ``key=value``, where ``--key=value`` and ``--flag`` are taken, too.

    Args:
        verb: For messages.
        arguments: After the verb.
        known: Name → default; a value given must be of the default's type (a whole number, true or false, text).
        more: Whether other keys are allowed; they come back as they are.

    Returns:
        The known ones, and the others.

    Raises:
        UserError: An unknown key, or a value of another kind.
    """
    values, others = dict(known), []
    for argument in arguments:
        key, equals, text = argument.removeprefix("--").partition("=")
        key = key.replace("-", "_") if argument.startswith("--") else key
        if key in known and (equals or isinstance(known[key], bool)):
            values[key] = _value(verb, key, text if equals else "true", known[key])
        elif more and equals and not argument.startswith("--"):
            others.append(argument)
        else:
            raise UserError(
                f"{verb}: {argument!r} is not one of {', '.join(f'{k}=…' for k in known)}"
                + (" or a configuration's key=value" if more else "")
            )
    return values, others


def _value(verb: str, key: str, text: str, default: Any) -> Any:
    if isinstance(default, bool):
        if text.lower() not in ("true", "false"):
            raise UserError(f"{verb}: {key}={text}: must be true or false")
        return text.lower() == "true"
    if isinstance(default, int):
        if not text.isdigit():
            raise UserError(f"{verb}: {key}={text}: must be a whole number of at least 0")
        return int(text)
    return text


def required(verb: str, values: Mapping[str, Any], *names: str) -> None:
    """Raises ``UserError`` if one of them was not given."""
    for name in names:
        if values[name] in ("", None):
            raise UserError(f"{verb}: give {name}=…; franka-wm {verb} --help")


def compose(overrides: Sequence[str], options: Sequence[str] = ()) -> Any:
    """The configuration of ``conf/`` with Hydra's overrides, as ``train.py`` would see it.

    Raises:
        UserError: One line, for an override that Hydra refuses.
    """
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    try:
        return conf.compose(*overrides)
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(explain(str(error), allowed=_allowed(str(error), overrides, options))) from error


_MISSING = re.compile(r"Could not find '([^']+)/([^'/]+)'")
_UNKNOWN = re.compile(r"Could not override '([^']+)'")


def explain(message: str, *, allowed: Sequence[str] = ()) -> str:
    """What Hydra and OmegaConf say of an override, in one line.

    Args:
        message: Theirs, of many lines: with the choices of a group, how to append, where configurations are.
        allowed: Keys that there are in the place of an unknown one.
    """
    lines = [line.strip() for line in message.splitlines() if line.strip()]
    missing, unknown = _MISSING.search(message), _UNKNOWN.search(message)
    if missing is not None:
        choices = [line for line in message.splitlines() if line.startswith("\t") and "provider=" not in line]
        names = [line.strip() for line in choices]
        return (
            f"{missing[1]}={missing[2]}: must be one of {', '.join(names)}{did_you_mean(missing[2], names)}"
        )
    if unknown is not None:
        near = did_you_mean(unknown[1], allowed)
        return f"{unknown[1]}: no such option{near or '; there are ' + ', '.join(allowed)}"
    noise = ("full_key:", "object_type", "Config search path", "provider=", "See https://", "Set the env")
    return "; ".join(line for line in lines if not line.startswith(noise))


def did_you_mean(word: str, known: Sequence[str]) -> str:
    """``; did you mean NAME?`` for the nearest of the known words; empty if none is near."""
    near = difflib.get_close_matches(word, known, n=1, cutoff=0.75)
    return f"; did you mean {near[0]}?" if near else ""


def _allowed(message: str, overrides: Sequence[str], options: Sequence[str]) -> list[str]:
    """The keys beside the one that an override names in vain; at the top, the verb's own, too."""
    from omegaconf import DictConfig, OmegaConf

    unknown = _UNKNOWN.search(message)
    if unknown is None:
        return []
    # With the same choices of groups: other environments have other options.
    chosen = [o for o in overrides if "." not in o.partition("=")[0] and o.partition("=")[0] != unknown[1]]
    node: Any = conf.compose(*chosen)
    place = unknown[1].rpartition(".")[0] if "/" not in unknown[1] and "@" not in unknown[1] else ""
    found = OmegaConf.select(node, place) if place else node
    if isinstance(found, DictConfig):
        return [
            f"{place}.{key}" if place else str(key)
            for key in dict.fromkeys([*([] if place else options), *found])
        ]
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


def wants_help(arguments: list[str], usage: str) -> bool:
    """Prints the usage if that is what is asked for."""
    asked = any(argument in ("--help", "-h") for argument in arguments)
    if asked:
        print(f"usage: franka-wm {usage}")
    return asked


def split_arguments(arguments: list[str], options: set[str], usage: str) -> tuple[list[str], dict[str, str]]:
    """Folders, and what stands as ``name=value``.

    Raises:
        UserError: an option that does not exist.
    """
    folders, given = [], {}
    for argument in arguments:
        name, equals, value = argument.partition("=")
        if equals and name in options:
            given[name] = value
        elif argument.startswith("-") or (equals and not Path(argument).exists()):
            raise UserError(f"unknown option {argument!r}; usage: franka-wm {usage}")
        else:
            folders.append(argument)
    return folders, given
