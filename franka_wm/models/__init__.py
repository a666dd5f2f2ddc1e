"""Families of latent world models, by name.

Every family is a `WorldModel` (`franka_wm.models.base`): `encode(observation) -> z` and `loss(batch) -> TensorDict`,
and the optional abilities that it defines, such as `next(z, action) -> z'`, `reward(z, action)` or `policy(z)`.
To add one, write one file here and one line in `_FAMILIES`, or call `register` with a class of your own. A family
is imported when it is made, and torch with the first of them: names alone are read without it.
"""

from __future__ import annotations

from importlib import import_module
from inspect import Parameter, signature
from typing import TYPE_CHECKING, Any

from franka_wm.errors import UserError, trying
from franka_wm.options import did_you_mean, refuse_ours

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
        UserError: the package has this name, or `cls` is no subclass of `WorldModel` with `encode` and `loss`.
    """
    from franka_wm.models.base import WorldModel

    refuse_ours(name, _FAMILIES)

    if not (isinstance(cls, type) and issubclass(cls, WorldModel)):
        raise UserError(f"model {name!r}: {cls!r} must be a subclass of franka_wm.models.WorldModel")
    lacking = [one for one in ("encode", "loss") if getattr(cls, one) is getattr(WorldModel, one)]
    if lacking:
        raise UserError(
            f"model {name!r}: {cls.__name__} must define encode and loss; {' and '.join(lacking)} "
            f"{'is' if len(lacking) == 1 else 'are'} missing, see docs/models.md"
        )
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
        UserError: one of your own answers in other shapes than `WorldModel` says, see `check_model`.
    """
    cls = family(name)
    if name not in _REGISTERED:
        return cls(**overrides)
    from franka_wm.models.check import check_model

    takes = signature(cls).parameters
    unknown = [key for key in overrides if key not in takes]
    if unknown and not any(one.kind is Parameter.VAR_KEYWORD for one in takes.values()):
        raise UserError(
            f"{cls.__name__} takes no {', '.join(unknown)}; a run gives observation_sizes, image_sizes where there are "
            "images, action_dim or num_actions, episode_length, and what its conf/model file has"
        )
    with trying(
        f"{cls.__name__}.__init__", TypeError, ValueError, ModuleNotFoundError
    ):  # of these the run says more
        made = cls(**overrides)
    check_model(made, action_dim=overrides.get("action_dim"))
    return made


def __getattr__(name: str) -> Any:
    if name != "WorldModel":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return import_module(f"{__name__}.base").WorldModel
