"""The robot, up to a TensorDict. Knows nothing of models.

Names are loaded when they are first used: importing this package imports neither the simulator nor torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from franka_wm.envs.config import FrankaConfig, Randomization

if TYPE_CHECKING:
    from franka_wm.envs.camera_math import look_at_angles, supersample
    from franka_wm.envs.discretize import DiscreteActions, discrete_action_table
    from franka_wm.envs.external import ExternalEnv
    from franka_wm.envs.franka import FrankaEnv
    from franka_wm.envs.high_quality import HighQualityRenderer, which_backends
    from franka_wm.envs.multitask import MultiTaskEnv
    from franka_wm.envs.sequences import franka_sequences, smooth_actions
    from franka_wm.envs.transformed import TransformedFrankaEnv

type Environment = FrankaEnv | TransformedFrankaEnv | MultiTaskEnv | ExternalEnv
"""What may be trained in. Only for annotations."""

__all__ = [
    "DiscreteActions",
    "FrankaConfig",
    "FrankaEnv",
    "HighQualityRenderer",
    "MultiTaskEnv",
    "Randomization",
    "TransformedFrankaEnv",
    "discrete_action_table",
    "franka_sequences",
    "look_at_angles",
    "smooth_actions",
    "supersample",
    "which_backends",
]

_WHERE = {
    "DiscreteActions": "discretize",
    "FrankaEnv": "franka",
    "HighQualityRenderer": "high_quality",
    "MultiTaskEnv": "multitask",
    "TransformedFrankaEnv": "transformed",
    "discrete_action_table": "discretize",
    "franka_sequences": "sequences",
    "look_at_angles": "camera_math",
    "smooth_actions": "sequences",
    "supersample": "camera_math",
    "which_backends": "high_quality",
}


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_WHERE[name]}"), name)
