"""From a resolved configuration to the parts of a run. The configuration stops here: parts get plain values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from torchrl.data import ReplayBuffer

from franka_wm import models, planning
from franka_wm.data.policies import NoopPolicy, OraclePolicy, SmoothRandomPolicy
from franka_wm.data.replay import make_replay
from franka_wm.envs import FrankaConfig, FrankaEnv, resolve_device
from franka_wm.envs.config import IMAGES, NUM_JOINTS, STATE_DIM
from franka_wm.envs.franka import check_robot
from franka_wm.errors import UserError
from franka_wm.planning import ModelPolicy, PlannerPolicy


def plain(node: Any) -> dict[str, Any]:
    """A configuration node as a plain dict."""
    return dict(OmegaConf.to_container(node, resolve=True)) if isinstance(node, DictConfig) else dict(node)  # type: ignore[arg-type]


def make_env(
    cfg: DictConfig, *, num_envs: int | None = None, seed: int | None = None, **changes: Any
) -> FrankaEnv:
    """The environment that ``cfg.env`` describes; ``changes`` override fields of its config."""
    values = plain(cfg.env)
    kind, urdf_path = values.pop("kind"), values.pop("urdf_path")
    if kind != "franka":
        raise UserError(f"env.kind={kind!r}: must be franka")
    return FrankaEnv(
        FrankaConfig.from_mapping(values | changes),
        num_envs=cfg.collector.num_envs if num_envs is None else num_envs,
        device=cfg.device,
        seed=cfg.seed if seed is None else seed,
        urdf_path=urdf_path,
    )


def make_evaluation_env(cfg: DictConfig, *, num_envs: int | None = None) -> FrankaEnv:
    """The same task for evaluation: with what the oracle reads; without pictures unless the model sees."""
    sees = "pixels" in observation_keys(cfg)
    observations = [o for o in ("pixels",) if sees] + ["state", "joint_target"]
    return make_env(
        cfg, num_envs=cfg.evaluation.episodes if num_envs is None else num_envs, observations=observations
    )


def observation_keys(cfg: DictConfig) -> list[str]:
    """What the model reads: everything but pictures that the environment emits."""
    keys = [key for key in cfg.env.observations if key not in IMAGES]
    if "state" not in keys:
        raise UserError(f"env.observations={list(cfg.env.observations)}: model={cfg.model.name} needs state")
    return keys


def make_model(cfg: DictConfig, env: FrankaEnv) -> Any:
    """The world model that ``cfg.model`` names, on the environment's device."""
    sizes = {key: env.observation_spec[key].shape[-1] for key in observation_keys(cfg)}
    return _make_model(cfg, sizes, env.action_dim, env.config.episode_length).to(env.device)


def _make_model(cfg: DictConfig, sizes: dict[str, int], action_dim: int, episode_length: int) -> Any:
    values = plain(cfg.model)
    name = values.pop("name")
    for key, value in values.items():
        if key.endswith(("_dim", "_layers", "num_q", "bins")) and (not isinstance(value, int) or value < 1):
            raise UserError(f"model.{key}={value!r}: must be a whole number of at least 1")
    try:
        return models.make(
            name, observation_sizes=sizes, action_dim=action_dim, episode_length=episode_length, **values
        )
    except (TypeError, ValueError) as error:
        raise UserError(f"model={name}: {error}") from error


def make_planner(cfg: DictConfig, action_dim: int) -> Any:
    """The planner that ``cfg.planner`` names."""
    values = plain(cfg.planner)
    name = values.pop("name")
    known = {"mppi": planning.MPPI}
    if name not in known:
        raise UserError(f"planner={name!r}: must be one of {', '.join(known)}")
    try:
        return known[name](action_dim=action_dim, **values)
    except (TypeError, ValueError) as error:
        raise UserError(f"planner={name}: {error}") from error


def make_policies(
    model: Any, planner: Any, env: FrankaEnv, *, seed: int = 0, smoothness: float = 0.7
) -> dict[str, Any]:
    """Every policy that can act or be compared, by name.

    ``random`` is smooth random (first-order autoregressive), ``oracle`` inverse kinematics with true geometry.
    """
    generator = torch.Generator(device=env.device).manual_seed(seed)
    return {
        "planner": PlannerPolicy.for_model(model, planner),
        "policy": ModelPolicy.for_model(model),
        "noop": NoopPolicy(env.action_dim),
        "random": SmoothRandomPolicy(env.action_dim, smoothness=smoothness, generator=generator),
        "oracle": OraclePolicy(env.kinematics, env.config),
    }


ACTORS = {"policy": "policy", "planner": "planner", "smooth": "random", "noop": "noop", "ik": "oracle"}
"""What ``collector.acts`` may be, and the policy that it names."""


POLICIES = ("planner", "policy", "noop", "random", "oracle")
LOGGERS = ("csv", "tensorboard")


def make_replay_buffer(cfg: DictConfig, device: torch.device) -> ReplayBuffer:
    """The replay buffer that ``cfg.replay`` describes."""
    return make_replay(
        capacity=cfg.replay.capacity,
        num_envs=cfg.collector.num_envs,
        window=cfg.replay.window,
        batch_size=cfg.replay.batch_size,
        device=device,
    )


def check(cfg: DictConfig) -> None:
    """What can be refused before anything is built."""
    resolve_device(cfg.device)
    numbers: Mapping[str, tuple[Any, float]] = {
        "collector.num_envs": (cfg.collector.num_envs, 1),
        "collector.steps_per_batch": (cfg.collector.steps_per_batch, 1),
        "collector.seed_steps": (cfg.collector.seed_steps, 1),
        "replay.capacity": (cfg.replay.capacity, 1),
        "replay.batch_size": (cfg.replay.batch_size, 1),
        "replay.window": (cfg.replay.window, 1),
        "trainer.updates": (cfg.trainer.updates, 0),
        "trainer.updates_per_batch": (cfg.trainer.updates_per_batch, 1),
        "evaluation.episodes": (cfg.evaluation.episodes, 2),
        "evaluation.video_episodes": (cfg.evaluation.video_episodes, 0),
        "evaluation.video_size": (cfg.evaluation.video_size, 16),
    }
    for name, (value, least) in numbers.items():
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise UserError(f"{name}={value!r}: must be a whole number of at least {least}")
    if cfg.evaluation.video_size % 2:
        raise UserError(
            f"evaluation.video_size={cfg.evaluation.video_size}: must be even, video codecs want it"
        )
    if cfg.collector.acts not in ACTORS:
        raise UserError(f"collector.acts={cfg.collector.acts!r}: must be one of {', '.join(ACTORS)}")
    if cfg.env.episode_length < cfg.replay.window:
        raise UserError(
            f"env.episode_length={cfg.env.episode_length} is shorter than replay.window={cfg.replay.window}; "
            "no window would fit into an episode"
        )
    for name, value in (("seed", cfg.seed),):
        if isinstance(value, bool) or not isinstance(value, int):
            raise UserError(f"{name}={value!r}: must be a whole number")
    for name, value in (("trainer.lr", cfg.trainer.lr), ("trainer.grad_clip", cfg.trainer.grad_clip)):
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not value > 0:
            raise UserError(f"{name}={value!r}: must be above 0")
    for name, value in (
        ("trainer.log_every", cfg.trainer.log_every),
        ("trainer.checkpoint_every", cfg.trainer.checkpoint_every),
        ("evaluation.every", cfg.evaluation.every),
    ):
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not value > 0:
            raise UserError(f"{name}={value!r}: must be a number of seconds above 0")
    for name, value in plain(cfg.planner).items():
        counts = name in ("horizon", "iterations") or name.startswith("num_")
        if counts and (isinstance(value, bool) or not isinstance(value, int)):
            raise UserError(f"planner.{name}={value!r}: must be a whole number")
    if not 0 <= cfg.collector.smoothness < 1:
        raise UserError(f"collector.smoothness={cfg.collector.smoothness}: must be at least 0 and below 1")
    if cfg.replay.capacity < (steps := cfg.collector.num_envs * (cfg.replay.window + 1)):
        raise UserError(
            f"replay.capacity={cfg.replay.capacity}: must be at least {steps}, one window for every world"
        )
    if cfg.replay.capacity < cfg.collector.num_envs * cfg.collector.steps_per_batch:
        raise UserError(f"replay.capacity={cfg.replay.capacity}: smaller than one batch of the collector")
    _check_names("evaluation.during", cfg.evaluation.during, POLICIES)
    _check_names("logger.names", cfg.logger.names, LOGGERS)
    values = plain(cfg.env)
    kind, urdf_path = values.pop("kind"), values.pop("urdf_path")
    if kind != "franka":
        raise UserError(f"env.kind={kind!r}: must be franka")
    config = FrankaConfig.from_mapping(values)
    keys = observation_keys(cfg)
    check_robot(config, urdf_path)
    sizes = {"state": STATE_DIM, "joint_target": NUM_JOINTS}
    _make_model(cfg, {key: sizes[key] for key in keys}, config.action_dim, config.episode_length)
    make_planner(cfg, config.action_dim)


def _check_names(option: str, names: Any, known: Sequence[str]) -> None:
    unknown = [name for name in names if name not in known]
    if unknown:
        raise UserError(f"{option}: no {unknown[0]!r}; choose from {', '.join(known)}")
