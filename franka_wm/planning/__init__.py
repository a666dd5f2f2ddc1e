"""Planners over a plain function `(z, action) -> z'`, and objectives; `franka_wm.policies` runs them.

Nothing here knows a model family: models enter as callables.
"""

from franka_wm.planning.base import Planner
from franka_wm.planning.cem import CEM
from franka_wm.planning.gradient import GradientPlanner
from franka_wm.planning.icem import ICEM
from franka_wm.planning.mcts import MCTS
from franka_wm.planning.mppi import MPPI
from franka_wm.planning.objectives import (
    ActionPenalty,
    GoalDistance,
    GoalImage,
    GoalPolicyPenalty,
    PolicyPenalty,
    RewardPlusValue,
    Smoothness,
    Sum,
)

__all__ = [
    "CEM",
    "ICEM",
    "MCTS",
    "MPPI",
    "ActionPenalty",
    "GoalDistance",
    "GoalImage",
    "GoalPolicyPenalty",
    "GradientPlanner",
    "Planner",
    "PolicyPenalty",
    "RewardPlusValue",
    "Smoothness",
    "Sum",
]
