"""N worlds in Newton, and the one captured graph that steps them.

``build`` makes model, solver and the arrays of the robot, ``scene`` adds what it can touch; ``arrays`` holds
what a step reads and writes; ``graph`` records and replays; ``bodies`` adds fingers and objects to a step;
``rendering`` renders; ``state`` saves and restores; ``compiling`` compiles kernels ahead; ``demonstrated`` holds
recorded states, ``pipeline`` the contacts that Newton finds; ``simulator`` says in which order.
"""

from franka_wm.envs.simulation.arrays import STATISTICS, Arrays
from franka_wm.envs.simulation.simulator import Simulation

__all__ = ["STATISTICS", "Arrays", "Simulation"]
