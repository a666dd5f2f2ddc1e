"""A robot arm that plans with a world model it learned, simulated thousands of times over on one GPU.

`franka_wm.envs` is the arm as a TorchRL environment, `franka_wm.models` learns `(z, a) -> z'` from it,
`franka_wm.planning` plans with what was learned. Importing this package imports none of them.
"""

from franka_wm.version import __version__ as __version__
