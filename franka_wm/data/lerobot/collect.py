"""``franka-wm collect``: a policy acts in many worlds at once, and its episodes go straight into a dataset."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from franka_wm.data.lerobot.command import compose, number, required, split
from franka_wm.data.lerobot.episodes import Episode, EpisodeCutter
from franka_wm.data.lerobot.provenance import describe
from franka_wm.data.lerobot.schema import FORMATS, SEED, schema_for
from franka_wm.data.lerobot.writer import DatasetWriter, default_shard_frames
from franka_wm.errors import UserError
from franka_wm.seeding import derive_seed

OPTIONS: dict[str, Any] = {
    "out": "",
    "episodes": 100,
    "policy": "smooth",
    "checkpoint": "",
    "format": "exact",
    "num_envs": 0,
    "workers": 2,
    "shard_frames": 0,
    "resume": False,
}

USAGE = f"""usage: franka-wm collect out=FOLDER [key=value …]

  out=FOLDER          where the dataset goes; it appears whole, at the end
  episodes=100        how many, with those of a resumed one
  policy=smooth       smooth (random), noop, ik (inverse kinematics), or a trained agent: a run's folder, a checkpoint,
                      hf:user/name
  policy=planner      which part of an agent acts: planner or policy; then checkpoint=… is the agent
  format=exact        {"; ".join(f"{name}: {line}" for name, line in FORMATS.items())}
  num_envs=…          worlds at once; collector.num_envs if not given
  workers=2           writing processes
  resume=true         go on with an unfinished dataset, or add to a finished one
  env=reach_pixels    any option of train.py: env=…, env.image_size=…, seed=…, device=…, collector.smoothness=…

Ctrl-C stops and leaves a dataset of the whole episodes so far."""

BATCH = 8192
"""Steps of all worlds in one batch of the collector, about."""

_SIMPLE = {"smooth": "random", "noop": "noop", "ik": "oracle"}
_PARTS = ("planner", "policy")


@dataclass
class Source:
    """Who acts where.

    Attributes:
        env: The worlds.
        policy: Writes ``action``.
        config: The resolved configuration, plain.
        name: Of the policy, for the dataset's provenance.
        seed: Of the run.
    """

    env: Any
    policy: Any
    config: dict[str, Any]
    name: str
    seed: int


def collect(arguments: Sequence[str]) -> int:
    """The verb."""
    import warp as wp

    from franka_wm.console import say

    wp.config.log_level = wp.LOG_WARNING  # its list of compiled modules drowns what there is to say
    if not arguments or arguments[0] in ("--help", "-h"):
        print(USAGE)
        return 0
    options, overrides = split("collect", arguments, OPTIONS, more=True)
    required("collect", options, "out")
    if options["episodes"] < 1:
        raise UserError("collect: episodes=0: must be at least 1")
    if options["format"] not in FORMATS:
        raise UserError(f"collect: format={options['format']!r}: must be one of {', '.join(FORMATS)}")
    source = open_source(options, overrides)
    out, whole = gather(
        source,
        out=options["out"],
        episodes=options["episodes"],
        format=options["format"],
        workers=options["workers"],
        shard_frames=options["shard_frames"] or None,
        resume=options["resume"],
    )
    if not whole:
        say(f"stopped; what was gathered is in {out}; add the rest with resume=true")
        return 130
    say(f"dataset: {out}")
    return 0


# -- who acts ------------------------------------------------------------------------------------------------------


def open_source(options: dict[str, Any], overrides: list[str]) -> Source:
    """Builds the worlds and the policy that the options name.

    Raises:
        UserError: One line, for what cannot be built.
    """
    name, checkpoint = options["policy"], options["checkpoint"]
    if name in _PARTS and not checkpoint:
        raise UserError(
            f"collect: policy={name} is a part of a trained agent; give checkpoint=RUN, or policy=RUN"
        )
    if name not in (*_SIMPLE, *_PARTS):
        if checkpoint:
            raise UserError(f"collect: policy={name!r}: must be one of {', '.join((*_SIMPLE, *_PARTS))}")
        if not name.startswith("hf:") and not Path(name).exists():
            raise UserError(
                f"collect: policy={name!r}: must be one of {', '.join(_SIMPLE)}, or the folder of a run"
            )
        name, checkpoint = "", name
    if name in _SIMPLE:
        return _simple(name, options, overrides)
    return _agent(name, checkpoint, options, overrides)


def _simple(name: str, options: dict[str, Any], overrides: list[str]) -> Source:
    from omegaconf import OmegaConf

    from franka_wm.commands.entry import with_scale
    from franka_wm.console import announced, say
    from franka_wm.envs import FrankaConfig, FrankaEnv
    from franka_wm.training import build

    cfg = compose(with_scale(overrides), tuple(OPTIONS))
    seed, smoothness = number(cfg, "seed"), number(cfg, "collector.smoothness", float)
    worlds = options["num_envs"] or min(number(cfg, "collector.num_envs"), options["episodes"])
    if not build.is_arm(cfg):
        raise UserError(
            f"collect: env.kind={cfg.env.kind!r}: datasets are gathered from the arm (env=reach, …)"
        )
    values = build.plain(cfg.env)
    added = [key for key in ("state", "joint_target") if key not in values["observations"]]
    if added:
        say(f"env.observations: adding {' and '.join(added)}, which a dataset always has")
    values["observations"] = [*values["observations"], *added]
    del values["kind"]
    urdf_path = values.pop("urdf_path")
    config = FrankaConfig.from_mapping(values)
    schema_for(config, format=options["format"])  # refuses what cannot be stored before anything is built
    with announced(f"building {worlds} worlds; a machine's first start compiles kernels for a minute or two"):
        env = FrankaEnv(config, num_envs=worlds, device=cfg.device, seed=seed, urdf_path=urdf_path)
    cfg.env.observations = values["observations"]
    import torch

    from franka_wm.policies.scripted import NoopPolicy, OraclePolicy, SmoothRandomPolicy

    makers: dict[str, Callable[[], Any]] = {
        "noop": lambda: NoopPolicy(env.action_dim),
        "ik": lambda: OraclePolicy(env.kinematics, config),
        "smooth": lambda: SmoothRandomPolicy(
            env.action_dim,
            smoothness=smoothness,
            generator=torch.Generator(device=env.device).manual_seed(
                derive_seed("policies", seed, "collection")
            ),
        ),
    }
    resolved: Any = OmegaConf.to_container(cfg, resolve=True)
    kept = {key: resolved[key] for key in ("env", "collector", "seed", "device")}
    return Source(env, makers[name](), kept, name, seed)


def _agent(part: str, checkpoint: str, options: dict[str, Any], overrides: list[str]) -> Source:
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException
    from yaml import YAMLError

    from franka_wm.console import announced
    from franka_wm.training.load import load_agent

    changes: dict[str, Any] = {}
    seed, device = None, "auto"
    for override in overrides:
        key, _, text = override.partition("=")
        try:
            value: Any = OmegaConf.from_dotlist([f"value={text}"]).value
        except (YAMLError, OmegaConfBaseException) as error:
            raise UserError(f"collect: {override}: {text!r} is not a value as in YAML") from error
        if key == "seed":
            seed = number(OmegaConf.create({"seed": value}), "seed")
        elif key == "device":
            device = text
        elif key.startswith("env."):
            changes[key.removeprefix("env.")] = (
                OmegaConf.to_container(value) if OmegaConf.is_config(value) else value
            )
        else:
            raise UserError(
                f"collect: {override}: an agent keeps its configuration; only seed=, device= and env.KEY= can change"
            )
    if "observations" in changes:
        changes["observations"] = [
            *changes["observations"],
            *(key for key in ("state", "joint_target") if key not in changes["observations"]),
        ]
    with announced(f"loading {checkpoint}"):
        agent = load_agent(
            checkpoint,
            num_envs=options["num_envs"] or min(64, options["episodes"]),
            device=device,
            env_changes=changes,
            seed=seed,
        )
    part = part or ("planner" if "planner" in agent.policies else "policy")
    if part not in agent.policies:
        raise UserError(f"collect: policy={part}: {checkpoint} has only {', '.join(agent.policies)}")
    resolved: Any = OmegaConf.to_container(agent.cfg, resolve=True)
    return Source(agent.env, agent.policies[part], resolved, f"{part} of {checkpoint}", int(agent.cfg.seed))


# -- gathering -----------------------------------------------------------------------------------------------------


def gather(
    source: Source,
    *,
    out: str | Path,
    episodes: int,
    format: str = "exact",
    workers: int = 2,
    shard_frames: int | None = None,
    resume: bool = False,
    every: float = 10.0,
) -> tuple[Path, bool]:
    """Runs the policy until there are so many episodes, and writes them.

    Every world contributes the same number of episodes (one more or less), its first ones: whoever ends early
    does not fill the dataset with short episodes.

    Args:
        source: Who acts where. The worlds' seed is derived from ``seed`` and the number of episodes that are there
            already; the feature ``seed`` says it.
        out, workers, shard_frames, resume: As for :class:`~franka_wm.data.lerobot.writer.DatasetWriter`.
        episodes: In all.
        format: Of pictures.
        every: Seconds between lines of progress.

    Returns:
        The dataset's folder, and whether all episodes are there (not after Ctrl-C).

    Raises:
        UserError: One line.
    """
    from torchrl.collectors import Collector

    from franka_wm.console import count, duration, say
    from franka_wm.interrupt import interruptible

    base = getattr(source.env, "base_env", source.env)
    schema = schema_for(base.config, format=format)
    worlds, length = base.num_envs, base.config.episode_length
    if shard_frames is None and workers:  # few episodes: still something for every process to do
        shard_frames = min(default_shard_frames(schema), -(-episodes * length // workers))
    provenance = describe(policy=source.name, seed=source.seed, config=source.config)
    with DatasetWriter(
        out,
        schema,
        provenance=provenance,
        workers=workers,
        shard_frames=shard_frames,
        resume=resume,
    ) as writer:
        left = episodes - writer.resumed
        if left <= 0:
            say(f"{writer.resumed} episodes are there already")
            return writer.finish(), True
        writer.start()
        seed = derive_seed("collection", source.seed, writer.resumed)
        source.env.set_seed(seed)
        quota = np.full(worlds, left // worlds) + (np.arange(worlds) < left % worlds)
        cutter = EpisodeCutter(schema, seed=seed, discrete=_table(source.env))
        collector = Collector(
            source.env,
            source.policy,
            frames_per_batch=worlds * max(1, min(length, BATCH // worlds)),
            total_frames=-1,
            track_traj_ids=False,
            no_cuda_sync=True,
            trust_policy=True,
        )
        started = said = time.perf_counter()
        before, steps = writer.episodes, 0
        with interruptible() as stop:
            batches = iter(collector)
            while writer.episodes < episodes and not stop():
                batch = next(batches)
                steps += batch.numel()
                writer.add(episode for episode in cutter.push(batch) if _wanted(episode, quota))
                now = time.perf_counter()
                if now - said >= every or writer.episodes >= episodes:
                    rate = (writer.episodes - before) / (now - started)
                    rest = f"   left {duration((episodes - writer.episodes) / rate)}" if rate else ""
                    say(
                        f"episodes {writer.episodes}/{episodes}   steps {count(steps)} "
                        f"({count(steps / (now - started))}/s){rest}"
                    )
                    said = now
            whole = writer.episodes >= episodes
        collector.shutdown()
        return writer.finish(), whole


def _wanted(episode: Episode, quota: np.ndarray) -> bool:
    _, world, number = episode.rows[SEED][0]
    return number < quota[world]


def _table(env: Any) -> Any:
    """The moves of an environment with discrete actions."""
    if env.action_spec.dtype.is_floating_point:
        return None
    return env.transform.table
