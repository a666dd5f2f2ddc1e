"""Planners by name, as `conf/planner` and `planner=` name them.

To add one: a file with a class that has `plan` (see `Planner`), a line in `_PLANNERS` or a call of `register`, and a
file in `conf/planner` with `name:` and the constructor's arguments.
"""

from collections.abc import Mapping
from dataclasses import fields
from importlib import import_module
from inspect import get_annotations, signature
from typing import Any

from franka_wm.errors import UserError
from franka_wm.options import OF_ONES_OWN, check_arguments, check_names, did_you_mean, refuse_ours

# name -> (module, class, whether it chooses among discrete actions, what it is in one line)
_PLANNERS: dict[str, tuple[str, str, bool, str]] = {
    "mppi": (
        "franka_wm.planning.mppi",
        "MPPI",
        False,
        "sampling with elites, a policy's candidates and warm start",
    ),
    "cem": ("franka_wm.planning.cem", "CEM", False, "cross-entropy method"),
    "icem": ("franka_wm.planning.icem", "ICEM", False, "cross-entropy with coloured noise and memory"),
    "gradient": (
        "franka_wm.planning.gradient",
        "GradientPlanner",
        False,
        "descent through the model, several starts",
    ),
    "mcts": ("franka_wm.planning.mcts", "MCTS", True, "tree search, PUCT or Gumbel"),
}
_REGISTERED: dict[str, tuple[type, bool, str]] = {}

PLAN_KEYWORDS = ("prior", "previous", "is_init", "explore", "generator")
"""What `Planner.plan` is given by keyword."""


def available() -> dict[str, str]:
    """The planners that `make` knows: name -> one line of description."""
    ours = {name: line for name, (_, _, _, line) in _PLANNERS.items()}
    return ours | {name: line for name, (_, _, line) in _REGISTERED.items()}


def is_search(name: str) -> bool:
    """Whether the planner chooses among discrete actions (tree search), instead of continuous actions.

    Raises:
        ValueError: no planner has this name.
    """
    _require(name)
    return _REGISTERED[name][1] if name in _REGISTERED else _PLANNERS[name][2]


def register(name: str, cls: type, *, search: bool = False, line: str = "") -> None:
    """Makes a planner of one's own known, for this process.

    Args:
        name: what `planner.name` will say.
        cls: built with `action_dim=…` (with `num_actions=…` if `search`) and the rest of the configuration.
        search: whether it chooses among discrete actions.
        line: what it is.

    Raises:
        UserError: the package has this name, or the class has no `plan` that can be called as `Planner.plan` is
            (no `search`, if it searches or is a `ContinuousPlanner`), or fields that no `@dataclass` reads.
    """
    refuse_ours(name, _PLANNERS)
    if isinstance(cls, type):  # else a function that makes one
        _check_class(name, cls, search)
    _REGISTERED[name] = (cls, search, line)


def planner(name: str) -> type:
    """The class of the planner `name`, or what makes one.

    Raises:
        ValueError: no planner has this name.
    """
    _require(name)
    if name in _REGISTERED:
        return _REGISTERED[name][0]
    module, cls, _, _ = _PLANNERS[name]
    return getattr(import_module(module), cls)


def validate(name: str, options: Mapping[str, Any]) -> None:
    """Check options against the types that the planner's constructor declares, and its `ranges` where it has some.

    Raises:
        UserError: an option that it does not have, or a value of another type or out of range.
    """
    cls = planner(name)
    check_names(cls, options, "planner")
    check_arguments(cls, options, "planner", getattr(cls, "ranges", None))


def make(name: str, **arguments: Any) -> Any:
    """Build the planner `name`.

    Raises:
        ValueError: no planner has this name, or an argument that cannot work.
        UserError: one of your own does not do what `Planner` promises, see `check_planner`.
    """
    if name in _REGISTERED and not is_search(name):
        from franka_wm.planning.check import check_planner

        # Another one than is used: it may remember what it was asked.
        check_planner(planner(name)(**arguments), action_dim=arguments["action_dim"], name=name)
    return planner(name)(**arguments)


def _require(name: str) -> None:
    if name not in _PLANNERS and name not in _REGISTERED:
        known = list(available())
        near = did_you_mean(name, known) or OF_ONES_OWN
        raise ValueError(f"must be one of {', '.join(known)}, got {name!r}{near}")


def _check_class(name: str, cls: type, search: bool) -> None:
    method = getattr(cls, "search" if search else "plan", None)
    said = f"register({name!r}, {cls.__name__})"
    if method is None:
        raise UserError(f"{said}: has no {'search' if search else 'plan'}; see docs/planning.md")
    if search:
        return
    _check_continuous(said, cls)
    try:
        signature(method).bind("self", "z", "next", "objective", **dict.fromkeys(PLAN_KEYWORDS))
    except TypeError as error:
        raise UserError(
            f"{said}: plan must take z, next, objective, and by keyword {', '.join(PLAN_KEYWORDS)}: {error}"
        ) from error


def _check_continuous(said: str, cls: type) -> None:
    """Refuses a subclass of `ContinuousPlanner` that has no search, or fields that its constructor does not take."""
    from franka_wm.planning.base import ContinuousPlanner

    if not issubclass(cls, ContinuousPlanner):
        return
    if cls.plan is ContinuousPlanner.plan and cls.search is ContinuousPlanner.search:
        raise UserError(f"{said}: must define search(query), which plans; see docs/planning.md")
    known = {one.name for one in fields(cls)}
    own = [name for name, kind in get_annotations(cls).items() if "ClassVar" not in str(kind)]
    if "__init__" not in vars(cls) and (unread := [name for name in own if name not in known]):
        raise UserError(
            f"{said}: write @dataclass(kw_only=True, eq=False) above the class: without it {', '.join(unread)} "
            "cannot be set; see docs/planning.md"
        )
