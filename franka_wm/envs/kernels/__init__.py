"""The Warp kernels of a control step, by concern. One thread per world unless a kernel says otherwise.

``servo`` turns actions into joint targets, ``observation`` reads the arm, ``bodies`` is about fingers and objects,
``articulated`` about drawers and doors, ``episodes`` ends and begins episodes, ``demonstrated`` begins them in recorded
states, ``randomization`` draws what each episode has anew, ``goals`` is about images of the goal, ``rendering`` aims cameras and
places images.
The kernels of a task are in the task's file.

Python numbers given to a captured launch are frozen into the graph, so whatever may change (seed, masks,
counters) lives in device arrays.
"""

from franka_wm.envs.kernels.functions import JOINTS, STATE, away_from_solids, chain_forward, episode_rng

__all__ = ["JOINTS", "STATE", "away_from_solids", "chain_forward", "episode_rng"]
