"""What the verbs that deal with datasets share: ``key=value`` arguments, and the configuration that the rest names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from franka_wm.errors import UserError


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


def compose(overrides: Sequence[str]) -> Any:
    """The configuration of ``conf/`` with Hydra's overrides, as ``train.py`` would see it.

    Raises:
        UserError: One line, for an override that Hydra refuses.
    """
    from hydra import compose, initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    from franka_wm.cli import CHECKOUT

    folder = CHECKOUT / "conf"
    if not folder.is_dir():
        raise UserError("conf/ is in a checkout of the repository, which this installation is not")
    try:
        GlobalHydra.instance().clear()
        with initialize_config_dir(str(folder), version_base="1.3"):
            return compose("config", overrides=list(overrides))
    except (HydraException, OmegaConfBaseException) as error:
        lines = [line.strip() for line in str(error).splitlines()]
        raise UserError("; ".join(line for line in lines if line and "object_type" not in line)) from error
    finally:
        GlobalHydra.instance().clear()
