"""What acts: policies that a TorchRL collector can run, over a model and a planner or by a script.

Those by a script (`franka_wm.policies.scripted`) need the arm's kinematics; the ones named here need no simulator.
"""

from franka_wm.policies.exploration import ExploringPolicy
from franka_wm.policies.planner import ModelPolicy, PlannerPolicy
from franka_wm.policies.search import SearchPolicy

__all__ = ["ExploringPolicy", "ModelPolicy", "PlannerPolicy", "SearchPolicy"]
