"""What acts: policies that a TorchRL collector can run, over a model and a planner or by a script.

Those by a script (`franka_wm.policies.scripted`) need the arm's kinematics; the ones named here need no simulator.
Names are loaded when they are first used: importing this package does not import torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from franka_wm.policies.exploration import ExploringPolicy
    from franka_wm.policies.planner import ModelPolicy, PlannerPolicy
    from franka_wm.policies.search import SearchPolicy

__all__ = ["ExploringPolicy", "ModelPolicy", "PlannerPolicy", "SearchPolicy"]

_WHERE = {
    "ExploringPolicy": "exploration",
    "ModelPolicy": "planner",
    "PlannerPolicy": "planner",
    "SearchPolicy": "search",
}


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_WHERE[name]}"), name)
