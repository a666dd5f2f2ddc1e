"""What is wrong with overrides of the configuration, in one line instead of Hydra's many."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from franka_wm.errors import UserError
from franka_wm.options import did_you_mean, no_such_option, preset_of_ones_own

type Compose = Callable[..., Any]
"""From overrides to their configuration; raises :func:`refusals`."""

EXTRAS = {
    "joblib": "joblib",
    "submitit_slurm": "slurm",
    "submitit_local": "slurm",
    "ray": "ray",
    "optuna": "optuna",
}
"""Launchers and sweepers of ``--multirun``, and the extra of this package that has each."""
_MISSING = re.compile(r"Could not find '([^']+)/([^'/]+)'")
_UNKNOWN = re.compile(r"Could not override '([^']+)'")


def refusals() -> tuple[type[Exception], ...]:
    """What composing raises; the last three for a group that is no name, or too long for one."""
    from hydra.errors import HydraException

    return HydraException, OmegaConfBaseException, ValueError, TypeError, OSError


def said_of(error: Exception, overrides: Sequence[str], compose: Compose, options: Sequence[str] = ()) -> str:
    """One line about overrides that are refused.

    Args:
        options: What else may stand at the top.
    """
    said = whole(error)
    return explain(said, allowed=_allowed(said, overrides, compose, options))


def whole(error: Exception) -> str:
    """What Hydra says; of a mapping, the cause names the key inside it."""
    said = str(error)
    return f"{said}\n{error.__cause__}" if _UNKNOWN.search(said) else said


def explain(message: str, *, allowed: Sequence[str] = ()) -> str:
    """What Hydra and OmegaConf say of an override, in one line.

    Args:
        message: Theirs, of many lines: with the choices of a group, how to append, where configurations are.
        allowed: Keys that there are in the place of an unknown one.
    """
    lines = [line.strip() for line in message.splitlines() if line.strip()]
    missing, unknown = _MISSING.search(message), unknown_key(message)
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


def unknown_key(message: str) -> str | None:
    """The key that an override names in vain; of one that sets a mapping, the key inside it."""
    unknown, full = _UNKNOWN.search(message), re.search(r"full_key: (\S+)", message)
    if unknown is None:
        return None
    return full[1] if full is not None and full[1].startswith(f"{unknown[1]}.") else unknown[1]


def composed(compose: Compose, *overrides: str) -> Any:
    """The configuration of some overrides; ``None`` where one of these is wrong, too."""
    try:
        return compose(*overrides)
    except (*refusals(), UserError):
        return None


def _allowed(message: str, overrides: Sequence[str], compose: Compose, options: Sequence[str]) -> list[str]:
    """The keys besides the one that an override names in vain; at the top, the verb's own, too."""
    unknown = unknown_key(message)
    if unknown is None:
        return []
    # With the same choices of groups, and where they are looked for: other environments have other options.
    keys = [(o.partition("=")[0], o) for o in overrides]
    chosen = [o for key, o in keys if key == "hydra.searchpath" or ("." not in key and key != unknown)]
    node = composed(compose, *chosen)
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
