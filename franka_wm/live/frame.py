"""What a session shows after each step, and what viewers listen to."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Frame:
    """What there is to see of the first world, copied to the host.

    Attributes:
        steps: Simulated since the session began.
        episode: Counts from 0.
        stepped: Whether this is a step's end; otherwise something was set by hand.
        policy: Who acts.
        bodies: Poses of the moving links and the objects (bodies, 7): position [m], quaternion xyzw.
        tool, goal: (3,) [m].
        path: Tool positions that the plan commands (H + 1, 3) [m]; None where the policy has no plan.
        contacts: Where things touched at the last step's end (C, 7): point [m], normal, force along it [N]; None where
            nobody asked, and after something was set by hand.
        reward: Reward of the last step; 0.0 before the first.
        distance: From tool to goal, at the last step's end, before any reset [m].
        success: Success of the last step.
        decision: Time that the policy took for the last step [s].
        recording: Steps recorded so far; None where nothing is recorded.
        recording_full: Whether the recording has come to its end by itself: further steps are not in it.
    """

    steps: int
    episode: int
    stepped: bool
    policy: str
    bodies: np.ndarray
    tool: np.ndarray
    goal: np.ndarray
    path: np.ndarray | None
    reward: float
    distance: float
    success: bool
    decision: float
    recording: int | None
    contacts: np.ndarray | None = None
    recording_full: bool = False
