"""Planners over a plain function `(z, action) -> z'`, and policies that run them.

Nothing here knows a model family: models enter as callables.
"""

from franka_wm.planning.mppi import MPPI
from franka_wm.planning.objectives import GoalDistance, RewardPlusValue
from franka_wm.planning.policy import ModelPolicy, PlannerPolicy

__all__ = ["MPPI", "GoalDistance", "ModelPolicy", "PlannerPolicy", "RewardPlusValue"]
