"""Options with a type and a range, declared where they are named.

A frozen dataclass reads itself from a configuration:

@dataclass(frozen=True)
class ReplaySettings:
    capacity: int = whole(least=1)
    hindsight: float | None = real(0.0, least=0, most=1, null="half, where goals can be exchanged")

read(ReplaySettings, {"capacity": 0}, "replay")   # UserError: replay.capacity=0: must be a whole number …

and a constructor (of a model, a planner) declares them by its annotations, and by bounds where there are some:

check_arguments(TDMPC2, {"tau": 0}, "model", {"tau": Bounds(above=0, most=1)})   # UserError: model.tau=0: must be a …
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, Field, dataclass, field, fields
from difflib import get_close_matches
from inspect import Parameter, signature
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Any, Literal, NamedTuple, TypeGuard, Union, get_args, get_origin, get_type_hints

from franka_wm.errors import UserError

ROBOT_OF_ONES_OWN = "; one of your own: plugins=[MODULE] imports its module, which must set SOURCES[NAME]"
OF_ONES_OWN = "; one of your own: plugins=[MODULE] imports its module, which must call register(NAME, …)"
"""Ends the refusal of a task, model or planner that is not known."""


def preset_of_ones_own(group: str, name: str) -> str:
    """Ends the refusal of a preset that no configuration folder has."""
    return f"; of your own: hydra.searchpath=[file://FOLDER], with {group}/{name}.yaml"


def refuse_ours(name: str, ours: Iterable[str]) -> None:
    """Refuse to register a name that the package has.

    Raises:
        UserError: One line.
    """
    if name in ours:
        raise UserError(f"register({name!r}, …): the package has this name; choose another")


@dataclass(frozen=True)
class Rule:
    """What an option may be.

    Attributes:
        fits: Whether a value that is not null does.
        wanted: The same in words, after "must be".
        null: What null means, or ""; None where null is not allowed.
    """

    fits: Callable[[Any], bool]
    wanted: str
    null: str | None = None

    def check(self, option: str, value: Any) -> None:
        """Raises a ``UserError`` that names the option and what is allowed, unless the value fits."""
        if not (self.null is not None if value is None else self.fits(value)):
            null = "" if self.null is None else ", or null" + (self.null and f" ({self.null})")
            raise UserError(f"{option}={value!r}: must be {self.wanted}{null}")


class Bounds(NamedTuple):
    """Interval of numbers: from ``least`` to ``most``; ``above`` and ``below`` themselves are outside."""

    least: float = -math.inf
    above: float = -math.inf
    most: float = math.inf
    below: float = math.inf

    def holds(self, number: float) -> bool:
        """Whether a number lies inside; NaN never does."""
        return self.least <= number <= self.most and self.above < number < self.below

    def __str__(self) -> str:
        words = ("of at least", "above", "of at most", "below")
        said = [
            f"{word} {_plain(bound)}" for word, bound in zip(words, self, strict=True) if math.isfinite(bound)
        ]
        return " " + " and ".join(said) if said else ""


def _plain(bound: float) -> str:
    """A whole number up to a billion with all its digits, as a count is written."""
    return str(int(bound)) if bound == int(bound) and abs(bound) <= 1e9 else f"{bound:g}"


POSITIVE = Bounds(least=1, most=10**6)
"""Sizes and counts."""
DEPTH = Bounds(least=1, most=1000)
"""Layers of a network."""
FRACTION = Bounds(least=0, most=1)
COEFFICIENT = Bounds(least=0, most=1e6)
"""Weights of losses, temperatures and the like."""


PRECISIONS = ("float32", "bfloat16")
"""What models compute in."""

LARGEST = 3e38
"""Largest finite number: what float32 holds."""


def is_whole(value: Any) -> TypeGuard[int]:
    """Whether it is an int that 64 bits hold; true and false are none."""
    return isinstance(value, Integral) and not isinstance(value, bool) and -(2**63) <= int(value) < 2**63


def is_real(value: Any) -> TypeGuard[float]:
    """Whether it is a finite number; true and false are none. torch takes no whole number beyond 64 bits."""
    if isinstance(value, Integral):
        return is_whole(value)
    return isinstance(value, Real) and -LARGEST <= value <= LARGEST  # type: ignore[operator]


def whole_rule(
    *, least: int, most: int | None = None, even: bool = False, unit: str = "", null: str | None = None
) -> Rule:
    """A whole number of at least ``least``, and of at most ``most``; even, if asked for."""
    wanted = f"{'an even' if even else 'a whole'} number{unit and f' of {unit}'} of at least {least}"
    wanted += "" if most is None else f" and of at most {most}"
    end = 2**63 - 1 if most is None else most
    return Rule(lambda x: is_whole(x) and least <= x <= end and not (even and x % 2), wanted, null)


def check_whole(option: str, value: Any, *, least: int = 1, **rule: Any) -> None:
    """Raises a ``UserError`` unless the value fits :func:`whole_rule`."""
    whole_rule(least=least, **rule).check(option, value)


def whole(default: Any = MISSING, **rule: Any) -> Any:
    """An option by :func:`whole_rule`."""
    return _option(default, whole_rule(**rule))


def real(default: Any = MISSING, *, unit: str = "", null: str | None = None, **bounds: float) -> Any:
    """A finite number within :class:`Bounds`."""
    within = Bounds(**bounds)
    wanted = f"a finite number{unit and f' of {unit}'}{within}"
    return _option(default, Rule(lambda x: is_real(x) and within.holds(x), wanted, null))


def flag(default: Any = MISSING, *, null: str | None = None) -> Any:
    """True or false."""
    return _option(default, Rule(lambda x: isinstance(x, bool), "true or false", null))


def choice(default: Any = MISSING, *, of: Sequence[str], null: str | None = None) -> Any:
    """One of several words."""
    return _option(default, Rule(lambda x: isinstance(x, str) and x in of, f"one of {', '.join(of)}", null))


def text(default: Any = MISSING, *, null: str | None = None) -> Any:
    """Any text that is not empty."""
    return _option(default, Rule(lambda x: isinstance(x, str) and bool(x), "text", null))


def several(default: Any = MISSING, *, each: Any, null: str | None = None, example: str) -> Any:
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


def value(
    default: Any = MISSING, *, fits: Callable[[Any], bool], wanted: str, null: str | None = None
) -> Any:
    """Any other kind of value, by a test of one's own."""
    return _option(default, Rule(fits, wanted, null))


def _option(default: Any, rule: Rule) -> Any:
    return field(default=default, metadata={"rule": rule}, kw_only=True)


def read[T](cls: type[T], values: Any, prefix: str) -> T:
    """An instance from a mapping of plain values.

    Args:
        cls: A dataclass whose fields are options of this module.
        values: Name → value; a name that is missing has the field's default.
        prefix: Prefix of the options' names, for messages.

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


def leaves(values: object, name: str = "") -> dict[str, Any]:
    """``{"env.fps": 20, …}`` of nested values; lists and empty mappings are values."""
    if not isinstance(values, Mapping) or (name and not values):
        return {name: values}
    nested = [leaves(value, f"{name}.{key}" if name else str(key)) for key, value in values.items()]
    return {key: value for one in nested for key, value in one.items()}


def unknown(option: str, known: Sequence[str]) -> str:
    """One line about an option that does not exist: the nearest ones, or all."""
    near = get_close_matches(option, known, n=3)
    if near:
        return f"{option}: there is no such option; did you mean {' or '.join(near)}?"
    return f"{option}: there is no such option; there are {', '.join(known)}"


def did_you_mean(word: str, known: Sequence[str]) -> str:
    """``; did you mean NAME?`` for the nearest of the known words; empty if none is near."""
    near = get_close_matches(word, known, n=1, cutoff=0.75)
    return f"; did you mean {near[0]}?" if near else ""


def no_such_option(name: str, known: Sequence[str]) -> str:
    """One line about an option that does not exist: the nearest one, that of another group, or all."""
    last = name.rpartition(".")[2]
    near = (
        did_you_mean(name, known)
        or (f"; did you mean {last}?" if last in known else "")
        or (f"; did you mean {known[0]}?" if len(known) == 1 else "")
    )
    return f"{name}: no such option{near or '; there are ' + ', '.join(known) if known else ''}"


def check_arguments(
    cls: Callable[..., Any],
    values: Mapping[str, Any],
    prefix: str,
    bounds: Mapping[str, Bounds] | None = None,
) -> None:
    """Hold values for a constructor against its annotations, and numbers against bounds.

    ``int``, ``float``, ``bool``, ``str``, ``Literal`` and ``None``, and unions of them, are checked. The rest is left
    to the class.

    Args:
        cls: A class, whose bases' constructors count as well, or a function that makes one.
        values: Name → value. Names that are no parameters are not looked at: see :func:`check_names`.
        prefix: Prefix of the options' names, for messages.
        bounds: Bounds of parameters that are numbers.

    Raises:
        UserError: A value of another type, or out of bounds.
    """
    for name, annotation in _annotations(cls).items():
        rule = _annotated(annotation, (bounds or {}).get(name, Bounds()))
        if name in values and rule is not None:
            rule.check(f"{prefix}.{name}", values[name])


def check_names(cls: Callable[..., Any], names: Iterable[str], prefix: str) -> None:
    """Refuse names that a constructor does not take.

    Raises:
        UserError: One line, with the nearest names that it does.
    """
    takes = signature(cls).parameters
    if any(one.kind is Parameter.VAR_KEYWORD for one in takes.values()):
        return
    for name in names:
        if name not in takes:
            raise UserError(unknown(f"{prefix}.{name}", [f"{prefix}.{one}" for one in takes]))


def with_defaults(cls: type, values: Mapping[str, Any]) -> dict[str, Any]:
    """`values`, and for those left out the defaults of the constructor of `cls`."""
    parameters = signature(cls.__init__).parameters.values()
    return {one.name: one.default for one in parameters if one.default is not one.empty} | dict(values)


def _annotations(cls: Callable[..., Any]) -> dict[str, Any]:
    """Types of all constructors' parameters, the nearest class's last."""
    makers: list[Any] = [cls]
    if isinstance(cls, type):
        ours = (
            one for one in reversed(cls.__mro__) if one.__module__.split(".")[0] not in ("builtins", "torch")
        )
        makers = [vars(one)["__init__"] for one in ours if "__init__" in vars(one)]
    found: dict[str, Any] = {}
    for one in makers:
        # A name that is imported for type checkers only leaves that constructor's values to its class.
        with suppress(NameError):
            found |= get_type_hints(one)
    found.pop("return", None)
    return found


def _annotated(annotation: Any, bounds: Bounds) -> Rule | None:
    """What a parameter may be by its annotation; None where it is of another kind."""
    kinds = get_args(annotation) if get_origin(annotation) in (Union, UnionType) else (annotation,)
    rules = [_of_kind(kind, bounds) for kind in kinds if kind is not NoneType]
    known = [one for one in rules if one is not None]
    if len(known) < len(rules):
        return None
    null = "" if NoneType in kinds else None
    return Rule(lambda x: any(one.fits(x) for one in known), " or ".join(one.wanted for one in known), null)


def _of_kind(kind: Any, bounds: Bounds) -> Rule | None:
    if get_origin(kind) is Literal:
        return Rule(lambda x: x in get_args(kind), f"one of {', '.join(map(str, get_args(kind)))}")
    rules = {
        bool: Rule(lambda x: isinstance(x, bool), "true or false"),
        int: Rule(lambda x: is_whole(x) and bounds.holds(x), f"a whole number{bounds}"),
        float: Rule(lambda x: is_real(x) and bounds.holds(x), f"a finite number{bounds}"),
        str: Rule(lambda x: isinstance(x, str), "text"),
    }
    return rules.get(kind)
