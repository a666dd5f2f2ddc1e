"""The planner's settings that sliders move, and planners rebuilt with other ones."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from franka_wm.errors import UserError

RANGES: dict[str, tuple[float, float, float]] = {
    "horizon": (1, 24, 1),
    "num_samples": (16, 2048, 16),
    "iterations": (1, 16, 1),
    "num_simulations": (2, 128, 2),
    "temperature": (0.05, 10.0, 0.05),
}
"""Setting → lowest, highest, step of its slider."""


@dataclass(frozen=True)
class Setting:
    """One number of a planner: its present value, and the range of its slider, which holds that value."""

    name: str
    value: float
    low: float
    high: float
    step: float


def place_of(policy: Any) -> str:
    """The attribute under which a policy keeps its planner, or its tree search."""
    return "search" if hasattr(policy, "search") else "planner"


def planner_settings(planner: Any) -> list[Setting]:
    """Those of :data:`RANGES` that this planner has; an empty list for None."""
    out = []
    for name, (low, high, step) in RANGES.items():
        value = getattr(planner, name, None)
        if name not in _parameters(planner) or isinstance(value, bool) or not isinstance(value, int | float):
            continue
        if name == "num_samples":  # its parts must stay within it
            parts = [getattr(planner, part, 0) for part in ("num_elites", "num_policy_samples")]
            low = max(low, *(part for part in parts if isinstance(part, int)))
        out.append(Setting(name, value, min(low, value), max(high, value), step))
    return out


def retuned(
    planner: Any, changes: Mapping[str, float], *, seconds: Callable[[], float], budget: float
) -> Any:
    """:func:`rebuilt` within the sliders and a budget.

    Args:
        planner: The present one.
        changes: Setting → value.
        seconds: Measures a decision of the present planner [s].
        budget: Longest decision that the settings may lead to [s].

    Raises:
        UserError: Also for a value outside of its slider, or a decision that would take longer than the budget.
    """
    for setting in planner_settings(planner):
        if not setting.low <= changes.get(setting.name, setting.value) <= setting.high:
            raise UserError(
                f"{setting.name}={changes[setting.name]:g}: must be from {setting.low:g} to {setting.high:g}"
            )
    other = rebuilt(planner, **changes)
    more = work(other) / work(planner)
    if more > 1 and (expected := more * seconds()) > budget:
        raise UserError(
            f"a decision would take about {expected:.1f} s, and at most {budget:g} s is allowed here; "
            "first make another setting smaller"
        )
    return other


def rebuilt(planner: Any, **changes: Any) -> Any:
    """A planner of the same kind with other settings; the given one is left as it is.

    Raises:
        UserError: A setting that the planner does not have, or a value that it refuses.
    """
    names = _parameters(planner)
    for name in changes:
        if name not in names:
            raise UserError(
                f"{type(planner).__name__} has no setting {name!r}; choose from {', '.join(names)}"
            )
    try:
        values = {name: getattr(planner, name) for name in names}
        return type(planner)(**(values | changes))
    except (AttributeError, TypeError, ValueError) as error:
        raise UserError(f"{type(planner).__name__}: {error}") from error


def work(planner: Any) -> float:
    """How many steps of the model a decision takes, up to a factor that settings do not change."""
    counts = ("horizon", "num_samples", "iterations", "num_simulations")
    return math.prod(getattr(planner, name, 1) for name in counts)


def _parameters(planner: Any) -> list[str]:
    """What the planner's constructor takes; a planner keeps each under the same name."""
    return [] if planner is None else list(inspect.signature(type(planner)).parameters)
