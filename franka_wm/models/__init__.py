"""Families of latent world models, by name.

Every family is a `torch.nn.Module` with `encode(observation) -> z`, `next(z, action) -> z'` and
`loss(batch) -> TensorDict`, and, where it has them, `reward(z, action)`, `value(z)` and `policy(z)`.
To add one, write one file here and one line in `_FAMILIES`, or call `register` with a class of your own. A family
is imported when it is made.
"""

from importlib import import_module
from typing import Any

# name -> (module, class, what it is in one line)
_FAMILIES: dict[str, tuple[str, str, str]] = {
    "tdmpc2": (
        "franka_wm.models.tdmpc2",
        "TDMPC2",
        "TD-MPC2: latent dynamics, reward, value and policy, no decoder",
    ),
    "muzero": (
        "franka_wm.models.muzero",
        "MuZero",
        "MuZero: a latent model for tree search over a few discrete moves",
    ),
    "jepa": (
        "franka_wm.models.jepa",
        "JEPA",
        "JEPA: pretrains a vision encoder from pictures alone (I-JEPA, V-JEPA, LeJEPA)",
    ),
    "lewm": (
        "franka_wm.models.lewm",
        "LeWorldModel",
        "LeWorldModel: action-conditioned JEPA trained end to end with SIGReg",
    ),
    "action_world_model": (
        "franka_wm.models.action_world_model",
        "ActionWorldModel",
        "V-JEPA 2-AC: transformer dynamics over the tokens of a pretrained encoder",
    ),
}
_REGISTERED: dict[str, tuple[type, str]] = {}


def register(name: str, cls: type, *, line: str = "") -> None:
    """Make a family of one's own known, for this process.

    Args:
        name: what `model.name` will say.
        cls: a `torch.nn.Module` with the methods above.
        line: what it is.
    """
    _REGISTERED[name] = (cls, line)


def available() -> dict[str, str]:
    """The families that `make` knows: name -> one line of description."""
    ours = {name: line for name, (_, _, line) in _FAMILIES.items()}
    return ours | {name: line for name, (_, line) in _REGISTERED.items()}


def family(name: str) -> type:
    """The class of the family `name`.

    Raises:
        ValueError: no family has this name; the message lists those that exist.
    """
    if name in _REGISTERED:
        return _REGISTERED[name][0]
    if name not in _FAMILIES:
        raise ValueError(f"unknown model {name!r}; available: {', '.join(sorted(available()))}")
    module, cls, _ = _FAMILIES[name]
    return getattr(import_module(module), cls)


def make(name: str, **overrides: Any) -> Any:
    """Build the model family `name`; `overrides` go to its constructor.

    The sizes known only at run time (for example `observation_sizes`, `action_dim`) are overrides too.

    Raises:
        ValueError: no family has this name; the message lists those that exist.
    """
    return family(name)(**overrides)
