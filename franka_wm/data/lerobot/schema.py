"""What a dataset of this arm holds: the features, by LeRobot's conventions, and where each comes from.

Row t of an episode is (o_t, a_t, and what followed a_t): ``next.reward``, ``next.success``, ``next.done``, … are of
the step that ``action`` led to, as LeRobot's own recorder writes them. The observation after the last action is
no row; :mod:`franka_wm.data.lerobot.terminal` keeps it.

=================================  ==================  ===========================================================
feature                            shape, dtype        meaning
=================================  ==================  ===========================================================
``observation.images.<camera>``    (H, W, 3) uint8     the camera's image
``observation.images.goal``        (H, W, 3) uint8     the arm at the goal, seen by the first camera
``observation.state``              (20,) float32       joints 7 [rad], velocities 7 [rad/s], tool 3, tool − goal 3 [m];
                                                       with a gripper (28,): fingers 2 [m], their speeds 2, tool's
                                                       quaternion 4, and one number more in actions and targets
``observation.environment_state``  (3,) float32        the goal [m]
``action``                         (A,) float32        in [−1, 1]
``next.reward``                    (1,) float32
``next.done``                      (1,) bool           ``terminated`` or ``truncated``
``next.terminated``                (1,) bool           ended by the task
``next.truncated``                 (1,) bool           ended by time, or by a world that broke
``next.success``                   (1,) bool           what the task says; of reach: tool within
                                                       ``success_distance`` of the goal
``joint_positions``                (7,) float32        [rad]; the first seven of the state
``tool_position``                  (3,) float32        [m]
``joint_target``                   (7,) float32        the servo's commanded angles [rad]
``observation.contacts``           (2,) float32        force at each finger [N], if it was observed
``objects``                        (13 · K,) float32   of each object: position, quaternion, two velocities;
                                                       behind them numbers of drawers and doors
``seed``                           (3,) int64          seed of the run, world, episode: what the episode's draws
                                                       depend on; the episode is −1 where it is not known
``episode_key``                    (1,) int64          fingerprint of the episode's numbers
=================================  ==================  ===========================================================

LeRobot gives every ``observation.…`` vector to a policy. What a policy must not see has no such prefix.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from franka_wm.errors import UserError

if TYPE_CHECKING:  # writing processes need this module, and neither torch nor the simulator
    from franka_wm.envs import FrankaConfig

FORMATS = {
    "exact": "PNG inside parquet: every image comes back bit for bit; for training",
    "video": "LeRobot's default codec (AV1): small, for sharing and viewers; blurs small motion",
    "video_near_lossless": "h264, 4:4:4, crf 0: each channel off by 2 of 255 at most; plays in most viewers",
}
"""How images are stored: name → what it is."""

IMAGE_PREFIX = "observation.images."
STATE, GOAL, ACTION = "observation.state", "observation.environment_state", "action"
REWARD, DONE, TERMINATED = "next.reward", "next.done", "next.terminated"
TRUNCATED, SUCCESS = "next.truncated", "next.success"
JOINTS, TOOL, TARGET, OBJECTS = "joint_positions", "tool_position", "joint_target", "objects"
CONTACTS = "observation.contacts"
SEED, EPISODE_KEY = "seed", "episode_key"

AUTOMATIC = ("timestamp", "frame_index", "episode_index", "index", "task_index")
"""Columns that LeRobot fills in itself."""

OWN_FOLDER = "meta/franka_wm"
"""Where a dataset keeps what is ours: terminal observations, provenance. LeRobot's readers ignore it."""
PROVENANCE = f"{OWN_FOLDER}/provenance.json"

_AXES = ("x", "y", "z")
_JOINT_NAMES = [f"joint_{i}" for i in range(1, 8)]


def _named(prefix: str) -> list[str]:
    return [f"{prefix}.{axis}" for axis in _AXES]


_STATE_NAMES = [
    *(f"{joint}.pos" for joint in _JOINT_NAMES),
    *(f"{joint}.vel" for joint in _JOINT_NAMES),
    *_named("tool"),
    *_named("tool_minus_goal"),
]
_HAND_NAMES = [
    *(f"finger_{i}.pos" for i in (1, 2)),
    *(f"finger_{i}.vel" for i in (1, 2)),
    *(f"tool.q{axis}" for axis in "xyzw"),
]
_OBJECT_NAMES = [
    *_AXES,
    *(f"q{axis}" for axis in "xyzw"),
    *(f"v{axis}" for axis in _AXES),
    *(f"w{axis}" for axis in _AXES),
]
_ACTION_NAMES = {
    "joint_delta": [f"{joint}.target_change" for joint in _JOINT_NAMES],
    "joint_position": [f"{joint}.target" for joint in _JOINT_NAMES],
    "ee_delta": _named("tool_change"),
}


@dataclass(frozen=True)
class Schema:
    """Features of a dataset.

    Attributes:
        features: LeRobot's feature dict (dtype, shape as a tuple, names), without the automatic columns.
        sources: Feature → key of the environment's TensorDict, for what is observed (``observation.state`` →
            ``state``, …). These have a terminal observation, as have ``derived``.
        derived: Feature → (key, first, last): a slice of another observation's last dimension.
        fps: Control steps per second.
        robot_type: What LeRobot shows as the robot.
        task: The task in words.
        format: One of :data:`FORMATS`.
    """

    features: dict[str, dict[str, Any]]
    sources: dict[str, str]
    derived: dict[str, tuple[str, int, int]]
    fps: int
    robot_type: str
    task: str
    format: str = "exact"

    @property
    def images(self) -> list[str]:
        """Features that are images."""
        return [key for key, feature in self.features.items() if feature["dtype"] in ("image", "video")]

    @property
    def observed(self) -> list[str]:
        """Features that an observation is made of: those that have a value after the last action, too."""
        return [key for key in self.features if key in self.sources or key in self.derived]

    @property
    def numbers(self) -> list[str]:
        """Features that are no images."""
        return [key for key in self.features if key not in self.images]

    def numpy_dtype(self, feature: str) -> np.dtype:
        """Type of one frame's value in memory."""
        return np.dtype("uint8" if feature in self.images else self.features[feature]["dtype"])

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        out = asdict(self)
        for feature in out["features"].values():
            feature["shape"] = list(feature["shape"])
        return out


def schema_for(
    config: FrankaConfig,
    *,
    format: str = "exact",
    keys: Sequence[str] | None = None,
    success: bool = True,
) -> Schema:
    """The schema of data from an environment.

    Args:
        config: The environment's.
        format: How images are stored; one of :data:`FORMATS`.
        keys: Observations that the data has (a replay keeps fewer than the environment emits). If not given:
            what the environment emits.
        success: Whether the data says if the task was solved.

    Raises:
        UserError: An unknown format, a frame rate that is not whole, or an observation that has no place in a
            LeRobot dataset, stacked images among them.
    """
    if format not in FORMATS:
        raise UserError(f"format={format!r}: must be one of {', '.join(FORMATS)}")
    if config.frame_stack > 1 and config.images:
        raise UserError(
            f"env.frame_stack={config.frame_stack}: a dataset holds single images; record with env.frame_stack=1"
        )
    if config.fps != round(config.fps):
        raise UserError(
            f"env.fps={config.fps:g}: LeRobot counts whole frames per second; choose a whole number"
        )
    if keys is None:
        keys = [
            *(_image_keys(config)),
            *(o for o in ("state", "joint_target", "objects", "contacts") if o in config.observations),
            "goal",
        ]
    features: dict[str, dict[str, Any]] = {}
    sources: dict[str, str] = {}
    derived: dict[str, tuple[str, int, int]] = {}

    def observed(feature: str, key: str, names: list[str]) -> None:
        features[feature] = _vector(len(names), names)
        sources[feature] = key

    for key in keys:
        if key.startswith(("depth", "segmentation")):
            raise UserError(
                f"env.observations: {key} has no place in a LeRobot dataset here; leave it out (pixels and "
                "goal_pixels are written)"
            )
        if key.startswith(("pixels", "goal_pixels")):
            feature = image_feature(key, config.cameras)
            features[feature] = {
                "dtype": "image" if format == "exact" else "video",
                "shape": (config.image_size, config.image_size, 3),
                "names": ["height", "width", "channels"],
            }
            sources[feature] = key
    if "state" in keys:
        observed(STATE, "state", _STATE_NAMES + _HAND_NAMES * config.has_gripper)
    if "goal" in keys:
        observed(GOAL, "goal", _named("goal"))
    names = _ACTION_NAMES[config.action_mode] + ["gripper.target"] * config.has_gripper
    features[ACTION] = _vector(len(names), names)
    features[REWARD] = {"dtype": "float32", "shape": (1,), "names": ["reward"]}
    for flag in (DONE, TERMINATED, TRUNCATED, *([SUCCESS] if success else [])):
        features[flag] = {"dtype": "bool", "shape": (1,), "names": [flag.removeprefix("next.")]}
    if "state" in keys:
        features[JOINTS] = _vector(len(_JOINT_NAMES), _STATE_NAMES[: len(_JOINT_NAMES)])
        derived[JOINTS] = ("state", 0, len(_JOINT_NAMES))
        features[TOOL] = _vector(3, _named("tool"))
        derived[TOOL] = ("state", len(_STATE_NAMES) - 6, len(_STATE_NAMES) - 3)
    if "joint_target" in keys:
        targets = [f"{joint}.target" for joint in _JOINT_NAMES] + ["gripper.target"] * config.has_gripper
        observed(TARGET, "joint_target", targets)
    if "objects" in keys and config.resolved_scene:
        scene = config.resolved_scene
        bodies = [body.name for body in (*scene.objects, *scene.articulated)]
        numbers = [f"{body}.{name}" for body in bodies for name in _OBJECT_NAMES]
        joints = [f"{one.name}.{name}" for one in scene.articulated for name in ("opened", "opened.vel")]
        observed(OBJECTS, "objects", numbers + joints)
    if "contacts" in keys:
        observed(CONTACTS, "contacts", ["finger_1.force", "finger_2.force"])
    features[SEED] = {"dtype": "int64", "shape": (3,), "names": ["run", "world", "episode"]}
    features[EPISODE_KEY] = {"dtype": "int64", "shape": (1,), "names": ["episode_key"]}
    return Schema(
        features=features,
        sources=sources,
        derived=derived,
        fps=round(config.fps),
        robot_type=_robot_type(config),
        task=config.task_class.words,
        format=format,
    )


def image_feature(key: str, cameras: Sequence[str]) -> str:
    """``pixels`` → ``observation.images.front``, ``pixels_wrist`` → ``….wrist``, ``goal_pixels`` → ``….goal``,
    ``goal_pixels_side`` → ``….goal_side``."""
    if key.startswith("goal_pixels"):
        return IMAGE_PREFIX + "goal" + key.removeprefix("goal_pixels")
    return IMAGE_PREFIX + (cameras[0] if key == "pixels" else key.removeprefix("pixels_"))


def episode_key(columns: Mapping[str, np.ndarray]) -> int:
    """Fingerprint of an episode: 52 bits of a hash of its numbers, so that a float holds it exactly.

    Images, automatic columns and the key itself do not count: what is read back from any of the
    formats has the key that was written.

    Args:
        columns: Feature → (T, …).
    """
    digest = hashlib.blake2b(digest_size=8)
    for name in sorted(columns):
        if name in AUTOMATIC or name == EPISODE_KEY or name.startswith(IMAGE_PREFIX):
            continue
        array = np.ascontiguousarray(columns[name])
        digest.update(f"{name}:{array.dtype}:{array.shape[0]};".encode())
        digest.update(array.tobytes())
    return int.from_bytes(digest.digest(), "little") >> 12


def _image_keys(config: FrankaConfig) -> list[str]:
    """As the environment names them: the first camera's without a suffix."""
    out = []
    for kind in config.images:
        out += [kind if camera == config.cameras[0] else f"{kind}_{camera}" for camera in config.cameras]
    return out


def _vector(size: int, names: Sequence[str]) -> dict[str, object]:
    return {"dtype": "float32", "shape": (size,), "names": list(names)}


def _robot_type(config: FrankaConfig) -> str:
    if config.robot.startswith("panda"):
        return "franka_panda"
    return "franka_fr3" if config.robot in ("embedded", "newton_asset") else f"franka_{config.robot}"
