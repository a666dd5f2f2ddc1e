"""What a model must know of its environment: sizes of observations and actions, length of episodes, rewards."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import torch

from franka_wm.envs import Environment
from franka_wm.envs.config import IMAGES, FrankaConfig
from franka_wm.envs.discretize import discrete_action_table
from franka_wm.envs.multitask_config import MultiTaskConfig
from franka_wm.envs.tasks import make_task
from franka_wm.errors import UserError

GOAL = "goal"
"""Key of the goal's position. Read only where it is named: `state` holds the way to the goal already."""


@dataclass(frozen=True)
class Spaces:
    """Sizes that a model is built for; saved with every checkpoint, so that a model needs no environment.

    Attributes:
        observation_sizes: Vector observations: key → size of the last dimension.
        image_sizes: Images, uint8: key → (height, width, channels).
        action_dim: Size of a continuous action; 0 where actions are discrete.
        num_actions: How many discrete actions there are; 0 where actions are continuous.
        episode_length: Steps, at most.
        reward_bounds: The least and the largest reward of a step; ``None`` where unknown.
        terminates: Whether episodes may end by more than their length.
        action_masks: For each of several tasks 1 where it has the entry of an action, else 0; ``None``: all have all.
    """

    observation_sizes: Mapping[str, int] = field(default_factory=dict)
    image_sizes: Mapping[str, tuple[int, int, int]] = field(default_factory=dict)
    action_dim: int = 0
    num_actions: int = 0
    episode_length: int = 50
    reward_bounds: tuple[float, float] | None = None
    terminates: bool = False
    action_masks: Sequence[Sequence[float]] | None = None

    def only(self, keys: Sequence[str] | None, reader: str) -> Spaces:
        """The same with the observations ``keys`` alone; with every vector but the goal if ``None``.

        Raises:
            UserError: One of them is not there.
        """
        if keys is None:
            vectors = {key: size for key, size in self.observation_sizes.items() if key != GOAL}
            if not vectors:
                raise UserError(
                    f"{reader} reads vectors, here are only {_list(self.image_sizes)}; add state to env.observations, "
                    "or choose model.observations"
                )
            return replace(self, observation_sizes=vectors, image_sizes={})
        there = [*self.observation_sizes, *self.image_sizes]
        for key in keys:
            if key not in there:
                raise UserError(
                    f"{reader} reads {key!r}, here are {_list(there)}; choose an env (or dataset) that has it, "
                    "or other model.observations"
                )
        if not keys:
            raise UserError(f"{reader}: model.observations is empty; choose from {_list(there)}")
        vectors = {key: self.observation_sizes[key] for key in keys if key in self.observation_sizes}
        images = {key: self.image_sizes[key] for key in keys if key in self.image_sizes}
        return replace(self, observation_sizes=vectors, image_sizes=images)

    def as_built(self, before: Spaces) -> tuple[Spaces, str]:
        """Sizes of here, with what gives the numbers of a trained model their meaning as it was; and what differs.

        The length of episodes is the unit of distances in steps. With the bounds of rewards it gives discount and range
        of values. Another one would read the same weights otherwise.
        """
        kept = {name: getattr(before, name) for name in ("episode_length", "reward_bounds", "terminates")}
        here = {name: getattr(self, name) for name in kept}
        other = [f"{name}={kept[name]} (here {here[name]})" for name in kept if kept[name] != here[name]]
        return replace(self, **kept), ", ".join(other)

    def as_dict(self) -> dict[str, Any]:
        """Plain, for a checkpoint."""
        values = asdict(self)
        return values | {"image_sizes": {key: list(size) for key, size in self.image_sizes.items()}}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Spaces:
        """Inverse of :meth:`as_dict`; what an older version did not save has its default."""
        images = {key: (size[0], size[1], size[2]) for key, size in values["image_sizes"].items()}
        bounds, length = values.get("reward_bounds"), values.get("episode_length", 1)
        if type(length) is not int or length < 1:
            raise ValueError(f"episode_length is {length!r}")
        return replace(
            cls(**values),
            image_sizes=images,
            reward_bounds=None if bounds is None else (bounds[0], bounds[1]),
        )

    @classmethod
    def of_config(cls, config: FrankaConfig, *, discrete: bool = False) -> Spaces:
        """Spaces of the arm, before it is built."""
        image_keys = [key for key in config.observations if key in IMAGES]
        names = {key: image_names(key, config) for key in image_keys}
        channels = {"depth": 1, "segmentation": 1, "pixels": 3 * config.frame_stack}
        channels["goal_pixels"] = channels["pixels"]
        size = config.image_size
        images = {name: (size, size, channels.get(key, 3)) for key in image_keys for name in names[key]}
        vectors = {
            "state": config.state_dim,
            "joint_target": config.target_dim,
            "objects": config.object_dim,
            "contacts": config.contact_dim,
        }
        rows = discrete_action_table(config.action_dim, gripper=config.has_gripper).shape[0]
        return cls(
            observation_sizes={key: size for key, size in vectors.items() if key in config.observations}
            | {GOAL: 3},
            image_sizes=images,
            action_dim=0 if discrete else config.action_dim,
            num_actions=rows if discrete else 0,
            episode_length=config.episode_length,
            reward_bounds=make_task(config).reward_bounds,
            terminates=config.terminate_on_success,
        )

    @classmethod
    def of_tasks(cls, config: MultiTaskConfig) -> Spaces:
        """Spaces of several tasks in one environment, before it is built."""
        parts = [cls.of_config(one) for one in config.tasks.values()]
        sizes = {"task": len(parts)}
        for key, size in (item for part in parts for item in part.observation_sizes.items()):
            sizes[key] = max(size, sizes.get(key, 0))
        most, bounds = max(part.action_dim for part in parts), [part.reward_bounds for part in parts]
        known = [one for one in bounds if one is not None]
        masks = [[float(k < part.action_dim) for k in range(most)] for part in parts]
        return cls(
            observation_sizes=sizes,
            action_dim=most,
            episode_length=config.episode_length,
            reward_bounds=(min(a for a, _ in known), max(b for _, b in known)) if known == bounds else None,
            terminates=config.terminate_on_success,
            action_masks=masks if any(0.0 in mask for mask in masks) else None,
        )

    @classmethod
    def of_env(cls, env: Environment) -> Spaces:
        """Spaces of an environment that is there."""
        vectors, images = {}, {}
        for key, spec in env.observation_spec.items():
            shape = spec.shape[1:]
            if key in ("success", "is_init", "step_count", "episode_reward"):
                continue
            if spec.dtype == torch.uint8 and len(shape) == 3:
                images[key] = tuple(shape)
            elif len(shape) == 1 and spec.dtype.is_floating_point:
                vectors[key] = shape[0]
        action = env.action_spec
        discrete = not action.dtype.is_floating_point
        return cls(
            observation_sizes=vectors,
            image_sizes=images,
            action_dim=0 if discrete else action.shape[-1],
            num_actions=int(action.n) if discrete else 0,  # type: ignore[attr-defined]
            episode_length=env.config.episode_length,
            reward_bounds=env.reward_bounds,
            terminates=env.terminates,
            action_masks=getattr(env, "action_masks", None),
        )


def image_names(key: str, config: FrankaConfig) -> list[str]:
    """The TensorDict keys of an image: the plain name for the first camera, with the camera's for others."""
    return [key, *(f"{key}_{camera}" for camera in config.cameras[1:])]


def _list(keys: Iterable[str]) -> str:
    return ", ".join(sorted(keys)) or "none"
