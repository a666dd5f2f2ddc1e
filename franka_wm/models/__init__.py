"""Families of latent world models, by name.

Every family is a `WorldModel` (`franka_wm.models.base`): `encode(observation) -> z` and `loss(batch) -> TensorDict`,
and the optional abilities that it defines, such as `next(z, action) -> z'`, `reward(z, action)` or `policy(z)`.
To add one, write one file here and one line in `_FAMILIES`, or call `register` with a class of your own. A family
is imported when it is made, and torch with the first of them: names alone are read without it.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from franka_wm.errors import UserError
from franka_wm.options import did_you_mean

if TYPE_CHECKING:
    from franka_wm.models.base import WorldModel

__all__ = ["WorldModel", "available", "family", "make", "register"]

# name -> (module, class, one line of description)
_FAMILIES: dict[str, tuple[str, str, str]] = {
    "tdmpc2": (
        "franka_wm.models.tdmpc2",
        "TDMPC2",
        "TD-MPC2: latent dynamics, reward, value and policy, no decoder",
    ),
    "dreamer": (
        "franka_wm.models.dreamer",
        "Dreamer",
        "DreamerV3: a recurrent model with decoder, and a policy learned in its imagination",
    ),
    "muzero": (
        "franka_wm.models.muzero",
        "MuZero",
        "MuZero: a latent model for tree search over a few discrete actions",
    ),
    "jepa": (
        "franka_wm.models.jepa",
        "JEPA",
        "JEPA: pretrains a vision encoder from images alone (I-JEPA, V-JEPA, LeJEPA)",
    ),
    "lewm": (
        "franka_wm.models.lewm",
        "LeWorldModel",
        "LeWorldModel: action-conditioned JEPA trained end to end with SIGReg",
    ),
    "dino_wm": (
        "franka_wm.models.dino_wm",
        "DINOWM",
        "DINO-WM: transformer dynamics over the patches of a frozen pretrained encoder",
    ),
    "action_world_model": (
        "franka_wm.models.action_world_model",
        "ActionWorldModel",
        "V-JEPA 2-AC: transformer dynamics over the tokens of a pretrained encoder",
    ),
}
_REGISTERED: dict[str, tuple[type[WorldModel], str]] = {}


def register(name: str, cls: type[WorldModel], *, line: str = "") -> None:
    """Make a family of one's own known, for this process.

    Args:
        name: what `model.name` will say.
        cls: subclass of `WorldModel`.
        line: one line of description.

    Raises:
        UserError: `cls` is no subclass of `WorldModel`.
    """
    from franka_wm.models.base import WorldModel

    if not (isinstance(cls, type) and issubclass(cls, WorldModel)):
        raise UserError(f"model {name!r}: {cls!r} must be a subclass of franka_wm.models.WorldModel")
    _REGISTERED[name] = (cls, line)


def available() -> dict[str, str]:
    """Families that `make` knows: name -> one line of description."""
    ours = {name: line for name, (_, _, line) in _FAMILIES.items()}
    return ours | {name: line for name, (_, line) in _REGISTERED.items()}


def family(name: str) -> type[WorldModel]:
    """Class of the family `name`.

    Raises:
        ValueError: no family has this name; the message lists those that exist.
    """
    if name in _REGISTERED:
        return _REGISTERED[name][0]
    if name not in _FAMILIES:
        known = sorted(available())
        raise ValueError(f"unknown model {name!r}; available: {', '.join(known)}{did_you_mean(name, known)}")
    module, cls, _ = _FAMILIES[name]
    return getattr(import_module(module), cls)


def make(name: str, **overrides: Any) -> WorldModel:
    """Build the model family `name`; `overrides` go to its constructor.

    The sizes known only at run time (for example `observation_sizes`, `action_dim`) are overrides too.

    Raises:
        ValueError: no family has this name; the message lists those that exist.
    """
    return family(name)(**overrides)


def __getattr__(name: str) -> Any:
    if name != "WorldModel":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return import_module(f"{__name__}.base").WorldModel
