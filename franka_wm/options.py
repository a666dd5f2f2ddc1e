"""Options with a type and a range, declared where they are named: a frozen dataclass reads itself from a configuration.

@dataclass(frozen=True)
class ReplaySettings:
    capacity: int = whole(least=1)
    hindsight: float | None = real(0.0, least=0, most=1, null="half, where goals can be exchanged")

read(ReplaySettings, {"capacity": 0}, "replay")   # UserError: replay.capacity=0: must be a whole number …
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field, fields
from difflib import get_close_matches
from inspect import Parameter, signature
from typing import Any

from franka_wm.errors import UserError


@dataclass(frozen=True)
class Rule:
    """What an option may be.

    Attributes:
        fits: Whether a value that is not null does.
        wanted: The same in words, after "must be".
        null: What null means; empty where it is not allowed.
    """

    fits: Callable[[Any], bool]
    wanted: str
    null: str = ""

    def check(self, option: str, value: Any) -> None:
        """Raises a ``UserError`` that names the option and what is allowed, unless the value fits."""
        if not (bool(self.null) if value is None else self.fits(value)):
            null = f", or null ({self.null})" if self.null else ""
            raise UserError(f"{option}={value!r}: must be {self.wanted}{null}")


def is_whole(value: Any) -> bool:
    """Whether it is an int; true and false are none."""
    return isinstance(value, int) and not isinstance(value, bool)


def is_real(value: Any) -> bool:
    """Whether it is a finite number; true and false are none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def whole(default: Any = MISSING, *, least: int, even: bool = False, unit: str = "", null: str = "") -> Any:
    """A whole number of at least ``least``; even, if asked for."""
    wanted = f"{'an even' if even else 'a whole'} number{unit and f' of {unit}'} of at least {least}"
    return _option(default, Rule(lambda x: is_whole(x) and x >= least and not (even and x % 2), wanted, null))


def real(
    default: Any = MISSING,
    *,
    least: float = -math.inf,
    above: float = -math.inf,
    most: float = math.inf,
    below: float = math.inf,
    unit: str = "",
    null: str = "",
) -> Any:
    """A finite number within bounds: from ``least`` to ``most``, ``above`` and ``below`` themselves excluded."""
    bounds = (("of at least", least), ("above", above), ("of at most", most), ("below", below))
    said = " and ".join(f"{word} {bound:g}" for word, bound in bounds if math.isfinite(bound))
    wanted = f"a finite number{unit and f' of {unit}'} {said}".strip()
    return _option(
        default, Rule(lambda x: is_real(x) and least <= x <= most and above < x < below, wanted, null)
    )


def flag(default: Any = MISSING, *, null: str = "") -> Any:
    """True or false."""
    return _option(default, Rule(lambda x: isinstance(x, bool), "true or false", null))


def choice(default: Any = MISSING, *, of: Sequence[str], null: str = "") -> Any:
    """One of several words."""
    return _option(default, Rule(lambda x: isinstance(x, str) and x in of, f"one of {', '.join(of)}", null))


def text(default: Any = MISSING, *, null: str = "") -> Any:
    """Any text that is not empty."""
    return _option(default, Rule(lambda x: isinstance(x, str) and bool(x), "text", null))


def several(default: Any = MISSING, *, each: Any, null: str = "", example: str) -> Any:
    """A list whose entries follow the rule of another option; it becomes a tuple."""
    rule: Rule = each.metadata["rule"]
    return _option(
        default,
        Rule(
            lambda x: isinstance(x, list | tuple) and all(rule.fits(one) for one in x),
            f"a list such as {example}; each entry {rule.wanted}",
            null,
        ),
    )


def value(default: Any = MISSING, *, fits: Callable[[Any], bool], wanted: str, null: str = "") -> Any:
    """Any other kind of value, by a test of one's own."""
    return _option(default, Rule(fits, wanted, null))


def _option(default: Any, rule: Rule) -> Any:
    return field(default=default, metadata={"rule": rule}, kw_only=True)


def read[T](cls: type[T], values: Any, prefix: str) -> T:
    """An instance from a mapping of plain values.

    Args:
        cls: A dataclass whose fields are options of this module.
        values: Name → value; a name that is missing has the field's default.
        prefix: Of the options' names, for messages.

    Raises:
        UserError: No mapping, an unknown or missing name, or a value of another type or out of range.
    """
    if not isinstance(values, Mapping):
        raise UserError(f"{prefix}={values!r}: must be a group of options")
    known: dict[str, Field[Any]] = {f.name: f for f in fields(cls)}  # type: ignore[arg-type]
    for name in values:
        if name not in known:
            raise UserError(unknown(f"{prefix}.{name}", [f"{prefix}.{one}" for one in known]))
    found = {}
    for name, one in known.items():
        value = values.get(name, one.default)
        if value is MISSING:
            raise UserError(f"{prefix}.{name} is missing")
        one.metadata["rule"].check(f"{prefix}.{name}", value)
        found[name] = tuple(value) if isinstance(value, list) else value
    return cls(**found)


def unknown(option: str, known: Sequence[str]) -> str:
    """One line about an option that does not exist: the nearest ones, or all."""
    near = get_close_matches(option, known, n=3)
    if near:
        return f"{option}: there is no such option; did you mean {' or '.join(near)}?"
    return f"{option}: there is no such option; there are {', '.join(known)}"


_TYPES = {
    "int": (is_whole, "a whole number"),
    "float": (is_real, "a finite number"),
    "bool": (lambda x: isinstance(x, bool), "true or false"),
    "str": (lambda x: isinstance(x, str), "text"),
    "None": (lambda x: x is None, "null"),
}


def check_arguments(cls: Any, values: Mapping[str, Any], prefix: str) -> Mapping[str, Parameter]:
    """The parameters of a constructor, after the values for it have been held against its annotations.

    ``int``, ``float``, ``bool``, ``str`` and ``None``, and unions of them, are checked; others are left to the class.

    Raises:
        UserError: A name that it does not take, or a value of another type.
    """
    takes = signature(cls).parameters
    known = [f"{prefix}.{name}" for name in takes if name != "self"]
    for name, value in values.items():
        if name not in takes:
            if any(one.kind is Parameter.VAR_KEYWORD for one in takes.values()):
                continue
            raise UserError(unknown(f"{prefix}.{name}", known))
        annotation = takes[name].annotation
        spelled = annotation.__name__ if isinstance(annotation, type) else str(annotation)
        kinds = [kind.strip() for kind in spelled.split("|")]
        if all(kind in _TYPES for kind in kinds) and not any(_TYPES[kind][0](value) for kind in kinds):
            wanted = " or ".join(_TYPES[kind][1] for kind in kinds)
            raise UserError(f"{prefix}.{name}={value!r}: must be {wanted}")
    return takes
