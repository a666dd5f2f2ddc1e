"""What is added to a dataset must be as what is there: recorded in the same environment, in the same form."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from franka_wm.data.lerobot.provenance import (
    DYNAMICS,
    LOOKS,
    MEANING,
    VIEWS,
    as_typed,
    flat,
    other_option,
    other_scene,
)
from franka_wm.data.lerobot.schema import IMAGE_PREFIX
from franka_wm.errors import UserError


def check_alike(
    out: str,
    other: Mapping[str, Any],
    schema: Mapping[str, Any],
    env: Mapping[str, Any],
    *,
    images: Iterable[str],
) -> None:
    """Refuse to mix.

    Args:
        out: Which dataset, for the message.
        other: ``sessions`` and ``schema`` of what is there.
        schema, env: What is to be added has, plain values.
        images: Features of ours that are images.

    Raises:
        UserError: It names what differs, and both values. Other errors: what is there has a form that nothing writes.
    """
    if not isinstance(other["sessions"], list):
        raise TypeError("sessions that are no list")
    what, close = f"{out}: what is there", "give the same, or another out"
    seen = any(images) and any(name.startswith(IMAGE_PREFIX) for name in other["schema"]["features"])
    env = flat(env)
    # Options before features, which follow from them; of options the task is the first.
    changed = other_option(other["sessions"], env, (*MEANING, *DYNAMICS, *((*VIEWS, *LOOKS) if seen else ())))
    if changed is not None:
        name, there = changed
        raise UserError(
            f"{what} was recorded with env.{name}={there}, this has {as_typed(env[name])}; {close}"
        )
    if other_scene(other["sessions"], env, images=seen, moves=True):
        raise UserError(f"{what} was recorded with another env.scene; {close}")
    if other["schema"] != schema:
        name, there, here = _first_difference(other["schema"], schema)
        raise UserError(
            f"{what} has {name}={there}, this has {here}; give the same env and format, or another out"
        )


def _first_difference(there: Mapping[str, Any], here: Mapping[str, Any]) -> tuple[str, Any, Any]:
    """The first entry of two schemas that differs, by name, and what it is there and here."""
    name = next(key for key in {**here, **there} if there.get(key) != here.get(key))
    one, other = there.get(name), here.get(name)
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        deeper, one, other = _first_difference(one, other)
        return f"{name}.{deeper}", one, other
    return name, _short(one), _short(other)


def _short(value: Any) -> Any:
    if isinstance(value, Mapping):  # a whole feature
        return f"{value['dtype']} {value['shape']}"
    return "none" if value is None else value
