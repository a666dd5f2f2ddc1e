"""Settings that several test files begin with."""

from __future__ import annotations

from typing import Any

GRIPPER: dict[str, Any] = {
    "observations": ("state", "joint_target", "objects"),
    "substeps": 4,
    "pose_noise": 0.02,
    "action_scale": 0.085,
    "limit_velocity": True,
    "gravity_compensation": True,
    "episode_length": 60,
}
"""What the presets of tasks with a gripper share, with fewer substeps."""

LIFT = {"task": "lift"} | GRIPPER
