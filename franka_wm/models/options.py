"""Checks of a family's options: types as the constructor annotates them, and ranges."""

from __future__ import annotations

import math
from collections.abc import Mapping
from inspect import signature
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

from franka_wm.errors import UserError


class Range(NamedTuple):
    """Interval of allowed values."""

    low: float
    high: float = math.inf
    without_low: bool = False
    without_high: bool = False

    def holds(self, value: Any) -> bool:
        """Whether `value` lies inside; nan never does."""
        above = value > self.low if self.without_low else value >= self.low
        return above and (value < self.high if self.without_high else value <= self.high)

    def __str__(self) -> str:
        if self.high == math.inf:
            return f"{'above' if self.without_low else 'at least'} {self.low:g}"
        left, right = "(" if self.without_low else "[", ")" if self.without_high else "]"
        return f"in {left}{self.low:g}, {self.high:g}{right}"


POSITIVE = Range(1)
"""Sizes and counts."""
FRACTION = Range(0.0, 1.0)
COEFFICIENT = Range(0.0)


def check_options(cls: type, options: Mapping[str, Any], ranges: Mapping[str, Range]) -> None:
    """Check the options that the constructors of `cls` and of its bases take.

    Raises:
        UserError: a wrong type, or a value out of its range.
    """
    for name, annotation in _annotations(cls).items():
        if name in options:
            _check(f"model.{name}", options[name], annotation, ranges.get(name))


def with_defaults(cls: type, options: Mapping[str, Any]) -> dict[str, Any]:
    """`options`, and for those left out the defaults of the constructor of `cls`."""
    parameters = signature(cls.__init__).parameters.values()
    return {one.name: one.default for one in parameters if one.default is not one.empty} | dict(options)


def _annotations(cls: type) -> dict[str, Any]:
    """Types of all constructors' parameters, the nearest class's last."""
    found: dict[str, Any] = {}
    for one in reversed(cls.__mro__):
        if "__init__" in vars(one) and one.__module__.split(".")[0] not in ("builtins", "torch"):
            found |= get_type_hints(one.__init__)
    found.pop("return", None)
    return found


def _check(name: str, value: Any, annotation: Any, allowed: Range | None) -> None:
    kinds = get_args(annotation) if get_origin(annotation) in (Union, UnionType) else (annotation,)
    nullable = NoneType in kinds
    if value is None and nullable:
        return
    kinds = tuple(kind for kind in kinds if kind is not NoneType)
    kind = kinds[0] if len(kinds) == 1 else None
    ending = ", or null" if nullable else ""
    bounds = "" if allowed is None else f" {allowed}"
    if kind is bool:
        if not isinstance(value, bool):
            raise UserError(f"{name}={value!r}: must be true or false{ending}")
    elif kind in (int, float):
        number = isinstance(value, Integral if kind is int else Real) and not isinstance(value, bool)
        if not number or not (allowed is None or allowed.holds(value)):
            what = "a whole number" if kind is int else "a number"
            raise UserError(
                f"{name}={value!r}: must be {what}{' of' if ' at' in bounds else ''}{bounds}{ending}"
            )
    elif kind is str:
        if not isinstance(value, str):
            raise UserError(f"{name}={value!r}: must be a word{ending}")
    elif get_origin(kind) is Literal and value not in get_args(kind):
        choices = ", ".join(str(one) for one in get_args(kind))
        raise UserError(f"{name}={value!r}: must be one of {choices}{ending}")
