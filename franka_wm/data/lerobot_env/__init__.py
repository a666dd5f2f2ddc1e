"""The arm as an environment of LeRobot's: what ``lerobot-eval`` and ``lerobot-train`` play policies in.

    lerobot-eval --policy.path=… --env.discover_packages_path=franka_wm.data.lerobot_env --env.type=franka_wm \\
        --env.dataset=FOLDER --eval.batch_size=16 --eval.n_episodes=16 --eval.use_async_envs=false

``--env.dataset`` takes the settings of the arm from a dataset that this package recorded, so that a policy meets the
task that it learned from. All episodes of a batch run in one simulation, on the GPU where there is one.

LeRobot imports what it discovers as a package; that is why this is a folder.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import batch_space
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from tensordict import TensorDictBase

from franka_wm.data.lerobot import schema
from franka_wm.data.lerobot.provenance import read_provenance
from franka_wm.envs.config import FrankaConfig
from franka_wm.envs.gym import REACH_V0, FrankaVectorEnv
from franka_wm.errors import UserError


class RecordedView(FrankaVectorEnv):
    """N arms that observe what a dataset of this package holds, under the keys that LeRobot reads.

    As :class:`~franka_wm.envs.gym.FrankaVectorEnv`, but ``agent_pos`` is the whole state (N, 20), or (N, 28) with a
    gripper, and ``pixels`` has every camera and, if observed, ``goal``.
    """

    def __init__(self, num_envs: int = 1, **options: Any):
        super().__init__(num_envs, **options)
        config = self.env.config
        sources = schema.schema_for(config).sources
        self._images = {
            feature.removeprefix(schema.IMAGE_PREFIX): key
            for feature, key in sources.items()
            if feature.startswith(schema.IMAGE_PREFIX)
        }
        self.task, self.task_description = config.task, task_sentence(config)
        entries: dict[str, spaces.Space] = {}
        if self._images:
            image = spaces.Box(0, 255, (config.image_size, config.image_size, 3), np.uint8)
            entries["pixels"] = spaces.Dict(dict.fromkeys(self._images, image))
        entries["agent_pos"] = spaces.Box(-np.inf, np.inf, (config.state_dim,), np.float32)
        entries["environment_state"] = spaces.Box(-np.inf, np.inf, (3,), np.float32)
        self.single_observation_space = spaces.Dict(entries)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)

    def step(
        self, actions: np.ndarray
    ) -> tuple[dict[str, Any], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """As above, with ``is_success`` at the end of an episode alone: LeRobot would count one that did not last."""
        observations, reward, terminated, truncated, info = super().step(actions)
        del info["is_success"]
        return observations, reward, terminated, truncated, info

    def _to_numpy(self, tensordict: TensorDictBase) -> tuple[dict[str, Any], np.ndarray]:
        out: dict[str, Any] = {}
        if self._images:
            out["pixels"] = {
                name: tensordict.get(key).contiguous().cpu().numpy() for name, key in self._images.items()
            }
        out["agent_pos"] = tensordict.get("state").contiguous().cpu().numpy()
        out["environment_state"] = tensordict.get("goal").contiguous().cpu().numpy()
        return out, tensordict.get("success").squeeze(-1).cpu().numpy()


@EnvConfig.register_subclass("franka_wm")
@dataclass
class FrankaWMEnv(EnvConfig):
    """``--env.type=franka_wm``.

    Attributes:
        task: Set from the arm's settings.
        fps: Likewise.
        dataset: Folder of a dataset of this package; the arm is set up as when it was recorded. ``None``: as
            ``FrankaWM/Reach-v0``.
        options: Changes of single settings: fields of :class:`~franka_wm.envs.FrankaConfig`.
        device: ``auto``, ``cpu``, ``cuda`` or ``cuda:K``.

    Raises:
        UserError: For a dataset without settings, or settings that cannot be.
    """

    dataset: str | None = None
    options: dict[str, Any] = field(default_factory=dict)
    device: str = "auto"

    def __post_init__(self) -> None:
        values = dict(REACH_V0) if self.dataset is None else recorded_settings(self.dataset)
        config = FrankaConfig.from_mapping(values | self.options)
        if config.action_mode == "ee_delta":
            raise UserError(
                f"action_mode={config.action_mode}: lerobot-eval drives joints here; use a dataset of joint actions"
            )
        self.config = config
        self.task, self.fps = config.task, round(config.fps)
        recorded = schema.schema_for(config)
        self.features = {
            "action": PolicyFeature(FeatureType.ACTION, (config.action_dim,)),
            "agent_pos": PolicyFeature(FeatureType.STATE, (config.state_dim,)),
            "environment_state": PolicyFeature(FeatureType.ENV, (3,)),
        }
        self.features_map = {
            "action": schema.ACTION,
            "agent_pos": schema.STATE,
            "environment_state": schema.GOAL,
        }
        for name in recorded.images:
            key = "pixels/" + name.removeprefix(schema.IMAGE_PREFIX)
            self.features[key] = PolicyFeature(FeatureType.VISUAL, tuple(recorded.features[name]["shape"]))
            self.features_map[key] = name

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Nothing: there is no single environment, see :meth:`create_envs`."""
        return {}

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gymnasium.vector.VectorEnv]]:
        """``{"franka_wm": {0: ENV}}``: one simulation of ``n_envs`` worlds, asynchronous or not."""
        from franka_wm.envs.franka import FrankaEnv

        env = FrankaEnv(self.config, num_envs=n_envs, device=self.device, seed=0)
        return {self.type: {0: RecordedView(env=env, render_mode="rgb_array")}}


def recorded_settings(root: str) -> dict[str, Any]:
    """The settings of the arm that a dataset was recorded with, as fields of ``FrankaConfig``.

    Without ``frame_stack``: of a run that stacked images, too, a dataset holds single ones.

    Raises:
        UserError: If the dataset does not say, or was recorded with several, or with a robot from a file.
    """
    provenance = read_provenance(root)
    if provenance is None or not provenance.get("sessions"):
        raise UserError(
            f"env.dataset={root}: has no {schema.PROVENANCE}; give a dataset that franka-wm wrote, or env.options"
        )
    settings = [dict(session["config"].get("env", session["config"])) for session in provenance["sessions"]]
    for one in settings:
        one.pop("frame_stack", None)
    if any(other != settings[0] for other in settings):
        raise UserError(f"env.dataset={root}: recorded with different settings; give env.options instead")
    if settings and settings[0].get("urdf_path"):
        raise UserError(
            f"env.dataset={root}: recorded with a robot of its own, env.urdf_path={settings[0]['urdf_path']}, which "
            "lerobot-eval cannot build; franka-wm evaluate can"
        )
    return {key: value for key, value in settings[0].items() if key not in ("kind", "urdf_path")}


def task_sentence(config: FrankaConfig) -> str:
    """The task in words, as datasets have it."""
    return schema.schema_for(config).task
