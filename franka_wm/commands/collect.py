"""``franka-wm collect``: any policy gathers a LeRobot dataset."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from franka_wm.commands.arguments import compose, number, required, split
from franka_wm.console import say
from franka_wm.data.lerobot.collect import Source, gather
from franka_wm.data.lerobot.schema import FORMATS, schema_for
from franka_wm.errors import UserError
from franka_wm.policies.names import refuse_old_name
from franka_wm.seeding import derive_seed

OPTIONS: dict[str, Any] = {
    "out": "",
    "episodes": 100,
    "policy": "random",
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
  policy=random       random (smooth motion), noop, ik (inverse kinematics), or a trained agent: a run's
                      folder, a checkpoint, hf:user/name
  policy=planner      which part of an agent acts: planner or policy; then checkpoint=… is the agent
  format=exact        {"; ".join(f"{name}: {line}" for name, line in FORMATS.items())}
  num_envs=…          worlds at once; collector.num_envs if not given
  workers=2           writing processes
  resume=true         go on with an unfinished dataset, or add to a finished one
  env=reach_pixels    any option of train.py: env=…, env.image_size=…, seed=…, device=…, collector.smoothness=…

Ctrl-C stops and leaves a dataset of the whole episodes so far."""

_SIMPLE = ("random", "noop", "ik")
_PARTS = ("planner", "policy")


def collect(arguments: Sequence[str]) -> int:
    """The verb."""
    import warp as wp

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
    if not Path(name).exists():
        refuse_old_name("collect: policy", name)
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
    from franka_wm.training.settings import plain

    cfg = compose(with_scale(overrides), tuple(OPTIONS))
    seed, smoothness = number(cfg, "seed"), number(cfg, "collector.smoothness", float)
    worlds = options["num_envs"] or min(number(cfg, "collector.num_envs"), options["episodes"])
    if cfg.env.kind != "franka":
        raise UserError(
            f"collect: env.kind={cfg.env.kind!r}: datasets are gathered from the arm (env=reach, …)"
        )
    values = plain(cfg.env)
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
        "random": lambda: SmoothRandomPolicy(
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
    settings = agent.settings
    return Source(
        agent.env, agent.policies[part], dict(settings.values), f"{part} of {checkpoint}", settings.seed
    )
