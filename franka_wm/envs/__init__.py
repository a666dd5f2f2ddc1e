"""The robot, up to a TensorDict. Knows nothing of models."""

from franka_wm.envs.config import FrankaConfig, Randomization
from franka_wm.envs.franka import FrankaEnv, TransformedFrankaEnv, resolve_device

__all__ = ["FrankaConfig", "FrankaEnv", "Randomization", "TransformedFrankaEnv", "resolve_device"]
