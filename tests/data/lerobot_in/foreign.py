"""LeRobot datasets made with LeRobot's own calls, as other people's look."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

SIDE = 32


def picture(
    episode: int, frame: int, camera: int = 0, *, height: int = SIDE, width: int = SIDE
) -> np.ndarray:
    """A smooth picture whose brightness and gradient say which one it is; survives a video codec."""
    y, x = np.mgrid[:height, :width] / max(height, width)
    base = 30 + 12 * frame
    channels = [base + 40 * x, 60 + 30 * episode + 40 * y, 120 * camera + 80 * (x + y) / 2]
    return np.stack(channels, -1).clip(0, 255).astype(np.uint8)


def action(episode: int, frame: int) -> np.ndarray:
    """Degrees, not [−1, 1]; the last component never changes."""
    return np.array([10.0 * frame - 30 * episode, 90 + frame, 7.0], np.float32)


def state(episode: int, frame: int) -> np.ndarray:
    return np.array([episode, frame], np.float32)


def make_foreign(
    root: Path,
    *,
    lengths: tuple[int, ...] = (5, 4, 7),
    video: bool = False,
    fps: int = 10,
    pictures: bool = True,
    after: tuple[str, ...] = ("next.reward", "next.done", "next.success"),
    width: int = SIDE,
    **changes: dict,
) -> Path:
    """A dataset with names of its own: cameras ``top`` and ``side``, joints in ``observation.joints``."""
    features: dict = {
        "observation.joints": {"dtype": "float32", "shape": (2,), "names": ["a", "b"]},
        "observation.gripper": {"dtype": "float32", "shape": (1,), "names": ["open"]},
        "action": {"dtype": "float32", "shape": (3,), "names": ["x", "y", "z"]},
    }
    if pictures:
        for camera in ("top", "side"):
            features[f"observation.images.{camera}"] = {
                "dtype": "video" if video else "image",
                "shape": (SIDE, width, 3),
                "names": ["height", "width", "channels"],
            }
    for name in after:
        features[name] = {
            "dtype": "float32" if name == "next.reward" else "bool",
            "shape": (1,),
            "names": None,
        }
    features |= changes
    dataset = LeRobotDataset.create("someone/else", fps=fps, features=features, root=root, use_videos=video)
    for episode, length in enumerate(lengths):
        for t in range(length):
            last = t == length - 1
            row: dict = {
                "observation.joints": state(episode, t),
                "observation.gripper": np.array([t % 2], np.float32),
                "action": action(episode, t),
                "next.reward": np.array([-t / 10], np.float32),
                "next.done": np.array([last]),
                "next.success": np.array([last and episode == 0]),
                "task": "push the block",
            }
            for k, camera in enumerate(("top", "side")):
                row[f"observation.images.{camera}"] = picture(episode, t, k, width=width)
            row = {name: value for name, value in row.items() if name in features or name == "task"}
            for name, spec in changes.items():
                row[name] = np.zeros(spec["shape"], spec["dtype"])
            dataset.add_frame(row)
        dataset.save_episode(parallel_encoding=False)
    dataset.finalize()
    return root
