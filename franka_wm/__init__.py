"""A robot arm that plans with a world model it learned, simulated thousands of times over on one GPU.

`franka_wm.envs` is the arm as a TorchRL environment, `franka_wm.models` learns `(z, a) -> z'` from it,
`franka_wm.planning` plans with what was learned. Importing this package imports none of them; the names here load
what they stand for when they are used.
"""

from typing import TYPE_CHECKING, Any

from franka_wm.version import __version__

if TYPE_CHECKING:
    from franka_wm.envs import FrankaConfig, FrankaEnv
    from franka_wm.training.load import load_agent
    from franka_wm.training.load import load_model as load

__all__ = ["FrankaConfig", "FrankaEnv", "__version__", "load", "load_agent"]


def __getattr__(name: str) -> Any:
    if name in ("FrankaConfig", "FrankaEnv"):
        from franka_wm import envs

        return getattr(envs, name)
    if name in ("load", "load_agent"):
        from franka_wm.training import load as loading

        return loading.load_model if name == "load" else loading.load_agent
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
