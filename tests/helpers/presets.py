"""Settings that several test files begin with."""

from __future__ import annotations

from typing import Any

LIFT: dict[str, Any] = {
    "task": "lift",
    "observations": ("state", "joint_target", "objects"),
    "substeps": 4,
    "pose_noise": 0.02,
    "action_scale": 0.085,
    "limit_velocity": True,
    "gravity_compensation": True,
    "episode_length": 60,
}
"""Of ``env=lift``, with fewer substeps."""
