"""The robot, up to a TensorDict. Knows nothing of models."""

from franka_wm.envs.config import FrankaConfig, Randomization
from franka_wm.envs.franka import FrankaEnv
from franka_wm.envs.transformed import TransformedFrankaEnv

__all__ = ["FrankaConfig", "FrankaEnv", "Randomization", "TransformedFrankaEnv"]
