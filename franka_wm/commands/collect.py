"""``franka-wm collect``: any policy gathers a LeRobot dataset."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click

from franka_wm.commands.arguments import FLAG, TYPED, check_run, plugins, real, verb, whole, word
from franka_wm.commands.overrides import compose, number
from franka_wm.console import announced, say
from franka_wm.data.lerobot.schema import FORMATS, schema_for
from franka_wm.errors import UserError
from franka_wm.interrupt import INTERRUPTED
from franka_wm.options import did_you_mean
from franka_wm.policies.names import refuse_old_name

if TYPE_CHECKING:
    from franka_wm.data.lerobot.collect import Gatherer

_SIMPLE = ("random", "noop", "ik", "expert")
_PARTS = ("planner", "policy")


@verb(
    "collect",
    others="",
    shown=(
        "KEY=VALUE",
        "any option of train.py: env=…, env.image_size=…, seed=…, device=…, collector.smoothness=…",
    ),
)
@word("out", "where the dataset goes; it appears whole, at the end", metavar="FOLDER", required=True)
@word("episodes", "how many, with those of a resumed one", whole(1, 10**9), 100)
@word(
    "policy",
    "random (smooth motion), noop, ik (inverse kinematics), expert (of tasks with a gripper), or an agent, which "
    "explores as in training: a run's folder, a checkpoint, hf:user/name",
    default="random",
)
@word("checkpoint", "an agent of which only a part acts: policy=planner or policy=policy", metavar="RUN")
@word(
    "format",
    "how images are stored: bit for bit, small, or small and nearly exact",
    click.Choice([*FORMATS]),
    "exact",
)
@word(
    "num_envs",
    "worlds at once, on all GPUs; if not given collector.num_envs, of an agent 64, no more than episodes are missing",
    whole(1),
    metavar="N",
)
@word("gpus", "of this host, one process each; with device=cpu so many on the CPU", whole(1), 1)
@word("workers", "writing processes, of each GPU", whole(0, 256), 2)
@word("shard_frames", "steps in one file, at least: each ends with an episode", whole(1), metavar="N")
@word("success_only", "keep only episodes that end in success", FLAG, False)
@word(
    "noise", "of the expert's actions, standard deviation; it recovers from that", real(0.0, 2.0), metavar="X"
)
@word("resume", "go on with an unfinished dataset, or add to a finished one", FLAG, False)
@plugins
def collect(gpus: int, overrides: Sequence[str], **options: Any) -> int:
    """Gather a LeRobot dataset with any policy.

    Ctrl-C stops and leaves a dataset of the whole episodes so far.
    """
    from franka_wm.commands import launching, several
    from franka_wm.data.lerobot.writer import check_out

    if several.started_by_torchrun():
        _in_a_job(overrides, options)
    check_out(options["out"], resume=options["resume"])
    if gpus == 1:
        try:
            return _collect(overrides, **options)
        except KeyboardInterrupt:  # the second one, or before the first episode
            return _stopped_at_once(options["out"])
    check_policy(options["policy"], options["checkpoint"], overrides, noise=options["noise"])
    _require_worlds(options["num_envs"] or options["episodes"], gpus)
    launching.launch_verb(
        ["collect", *_typed()], gpus, _device(overrides), lambda: "collect goes on with resume=true"
    )
    return 0


def _stopped_at_once(out: str) -> int:
    """Says what is left of a dataset that could not be finished; the exit status."""
    from franka_wm.data.lerobot.writer import episodes_there

    working = Path(f"{Path(out).absolute()}.writing")
    if working.exists():
        say(
            f"stopped at once; {episodes_there(out)} whole episodes are kept, no dataset was made of what is in "
            f"{working}; go on with resume=true"
        )
    elif Path(out).exists():
        say(f"stopped at once; the dataset in {out} is whole")
    else:
        say("stopped; nothing was written")
    return INTERRUPTED


def _typed() -> list[str]:
    return click.get_current_context().meta[TYPED]


def _device(overrides: Sequence[str]) -> str:
    return next((one.removeprefix("device=") for one in overrides if one.startswith("device=")), "auto")


def _in_a_job(overrides: Sequence[str], options: dict[str, Any]) -> NoReturn:
    """What each process of a job does that torchrun has started: its worlds' part of one dataset."""
    from franka_wm import processes
    from franka_wm.commands import several
    from franka_wm.commands.entry import ends_together
    from franka_wm.data.lerobot.writer import check_out

    with ends_together():
        several.meet(_typed(), _device(overrides))
        if _device(overrides) != "cpu":
            overrides = [one for one in overrides if not one.startswith("device=")]
            overrides.append(f"device={processes.own_gpu()}")
        options |= {"resume": options["resume"] or processes.restarted()}
        if processes.is_first():
            check_out(options["out"], resume=options["resume"])
        status = _collect(overrides, **options)
        processes.wait()
        processes.leave(status)
    raise AssertionError  # it has left


def _collect(
    overrides: Sequence[str],
    *,
    out: str,
    episodes: int,
    policy: str,
    checkpoint: str | None,
    format: str,
    num_envs: int | None,
    noise: float | None,
    **writing: Any,
) -> int:
    missing = _missing(out, episodes) if writing["resume"] else episodes
    source = open_source(
        policy, checkpoint, overrides, episodes=missing, num_envs=num_envs, format=format, noise=noise
    )
    from franka_wm.data.lerobot.collect import gather

    folder, complete = gather(source, out=out, episodes=episodes, format=format, **writing)
    if not complete:
        say(f"stopped; what was gathered is in {folder}; add the rest with resume=true")
        return INTERRUPTED
    say(f"dataset: {folder}")
    return 0


def _missing(out: str, episodes: int) -> int:
    """How many are still to be played; as many as there are processes at least, since each needs a world."""
    from franka_wm import processes
    from franka_wm.data.lerobot.writer import check_out, episodes_there

    check_out(out, resume=True)
    return max(episodes - episodes_there(out), min(episodes, processes.count()))


# -- who acts ------------------------------------------------------------------------------------------------------


def open_source(
    name: str,
    checkpoint: str | None = None,
    overrides: Sequence[str] = (),
    *,
    episodes: int,
    num_envs: int | None = None,
    format: str = "exact",
    noise: float | None = None,
) -> Gatherer:
    """Build the worlds and the policy.

    Args:
        name: Name of the policy, or place of an agent.
        checkpoint: The agent, if ``name`` is one of its parts.
        overrides: Changes of train.py's configuration; of an agent's, ``env.KEY=VALUE``, ``seed`` and ``device`` alone.
        episodes: How many will be played; no more worlds than that where ``num_envs`` is not given.
        num_envs: Worlds at once.
        format: Format of the dataset's images.
        noise: Noise of the expert's actions.

    Raises:
        UserError: One line, for what cannot be built.
    """
    name, checkpoint = check_policy(name, checkpoint, overrides, noise=noise)
    if name in _SIMPLE:
        return _simple(name, overrides, episodes, num_envs, format, noise or 0.0)
    return _agent(name, str(checkpoint), overrides, num_envs or min(64, episodes))


def _own(worlds: int) -> int:
    """How many of the worlds are this process's."""
    from franka_wm import processes

    _require_worlds(worlds, processes.count())
    return processes.own_part(worlds)[1]


def _require_worlds(worlds: int, count: int) -> None:
    if worlds < count:
        raise UserError(
            f"collect: {_counted(worlds)} for {count} processes: give num_envs={count}, or start fewer"
        )


def _counted(worlds: int) -> str:
    return "1 world" if worlds == 1 else f"{worlds} worlds"


def check_policy(
    name: str, checkpoint: str | None, overrides: Sequence[str], *, noise: float | None
) -> tuple[str, str | None]:
    """Check who shall act, before anything heavy is imported: the policy or the part of an agent, and the agent.

    Args and errors: as for :func:`open_source`.
    """
    if not Path(name).exists():
        refuse_old_name("collect: policy", name)
    if name in _PARTS and not checkpoint:
        raise UserError(
            f"collect: policy={name} is a part of a trained agent; give checkpoint=RUN, or policy=RUN"
        )
    if name in _SIMPLE and checkpoint:
        raise UserError(
            f"collect: checkpoint={checkpoint} goes with policy=planner or policy=policy, and here policy={name} acts; "
            f"policy={checkpoint} alone is the whole agent"
        )
    if name not in (*_SIMPLE, *_PARTS):
        if checkpoint:
            raise UserError(
                f"collect: policy={name!r}: must be one of {', '.join(known := (*_SIMPLE, *_PARTS))}"
                + did_you_mean(name, known)
            )
        if not name.startswith("hf:") and not Path(name).exists():
            raise UserError(
                f"collect: policy={name!r}: must be one of {', '.join(_SIMPLE)}, or the folder of a run"
                + did_you_mean(name, _SIMPLE)
            )
        name, checkpoint = "", name
    if checkpoint:
        check_run("collect", "checkpoint", checkpoint)
    if noise and name != "expert":
        raise UserError(f"collect: noise={noise:g}: is for policy=expert")
    if name in _SIMPLE:
        cfg = compose(overrides, tuple(collect.words))
        for key, kind in (("seed", int), ("collector.smoothness", float), ("collector.num_envs", int)):
            number(cfg, key, kind)
    return name, checkpoint


def _simple(
    name: str, overrides: Sequence[str], episodes: int, num_envs: int | None, format: str, noise: float
) -> Gatherer:
    from omegaconf import OmegaConf

    from franka_wm.commands.entry import with_scale
    from franka_wm.envs import FrankaConfig, FrankaEnv
    from franka_wm.training.storage_budget import check_worlds

    cfg = compose(with_scale(list(overrides), quiet=True))
    seed, smoothness = number(cfg, "seed"), number(cfg, "collector.smoothness", float)
    worlds = _own(num_envs or min(number(cfg, "collector.num_envs"), episodes))
    if cfg.env.kind != "franka":
        raise UserError(
            f"collect: env.kind={cfg.env.kind!r}: datasets are gathered from the arm (env=reach, …)"
        )
    values: Any = OmegaConf.to_container(cfg.env, resolve=True)
    del values["kind"]
    urdf_path = values.pop("urdf_path")
    if name == "expert" and (asked := FrankaConfig.from_mapping(values)).task_class.expert is None:
        solved = "" if asked.has_gripper else f"; policy=ik solves {asked.task} by inverse kinematics"
        raise UserError(
            f"collect: policy=expert: task={asked.task} has none; env=lift has one, for example{solved}"
        )
    needed = ("state", "joint_target", *(["objects"] if name == "expert" else []))
    added = [key for key in needed if key not in values["observations"]]
    if added:
        what = "a dataset always has" if "objects" not in added else "the expert and a dataset need"
        say(f"env.observations: adding {' and '.join(added)}, which {what}")
    values["observations"] = [*values["observations"], *added]
    config = FrankaConfig.from_mapping(values)
    schema_for(config, format=format)  # refuses what cannot be stored before anything is built
    check_worlds("num_envs", worlds, cfg.device)
    from franka_wm.policies.scripted import IKPolicy, NoopPolicy, SmoothRandomPolicy

    if name == "ik":
        IKPolicy.check(config)
    with announced(
        f"building {_counted(worlds)}; a machine's first start compiles kernels for a minute or two"
    ):
        env = FrankaEnv(config, num_envs=worlds, device=cfg.device, seed=seed, urdf_path=urdf_path)
    cfg.env.observations = values["observations"]
    import torch

    from franka_wm.data.lerobot.collect import Gatherer
    from franka_wm.policies.expert import ExpertPolicy
    from franka_wm.seeding import derive_seed

    generator = torch.Generator(device=env.device).manual_seed(derive_seed("policies", seed, "collection"))
    makers: dict[str, Callable[[], Any]] = {
        "noop": lambda: NoopPolicy.of(env),
        "ik": lambda: IKPolicy(env.kinematics, config),
        "random": lambda: SmoothRandomPolicy(
            env.action_dim,
            smoothness=smoothness,
            generator=generator,
        ),
        "expert": lambda: ExpertPolicy(
            env.simulation.task, env.kinematics, config, noise=noise, generator=generator
        ),
    }
    resolved: Any = OmegaConf.to_container(cfg, resolve=True)
    kept = {key: resolved[key] for key in ("env", "collector", "seed", "device")}
    return Gatherer(env, makers[name](), kept, name, seed)


def _agent(part: str, checkpoint: str, overrides: Sequence[str], worlds: int) -> Gatherer:
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException
    from yaml import YAMLError

    changed: Any = OmegaConf.create()
    seed, device = None, "auto"
    for override in overrides:
        key, _, text = override.partition("=")
        try:
            value: Any = OmegaConf.from_dotlist([f"value={text}"]).value
            if key.startswith("env."):
                changed = OmegaConf.merge(changed, OmegaConf.from_dotlist([override]))
        except (YAMLError, OmegaConfBaseException) as error:
            raise UserError(f"collect: {override}: {text!r} is not a value as in YAML") from error
        if key == "seed":
            seed = number(OmegaConf.create({"seed": value}), "seed")
        elif key == "device":
            device = text
        elif not key.startswith("env."):
            raise UserError(
                f"collect: {override}: an agent keeps its configuration; only seed=, device= and env.KEY= can change"
            )
    plain: Any = OmegaConf.to_container(changed)
    changes = plain.get("env", {})
    if isinstance(changes.get("observations"), list):  # else it is refused where it is read
        changes["observations"] = [
            *changes["observations"],
            *(key for key in ("state", "joint_target") if key not in changes["observations"]),
        ]
    from franka_wm.data.lerobot.collect import Gatherer
    from franka_wm.training.load import load_agent
    from franka_wm.training.storage_budget import check_worlds

    worlds = _own(worlds)
    check_worlds("num_envs", worlds, device)
    with announced(f"loading {checkpoint}"):
        agent = load_agent(checkpoint, num_envs=worlds, device=device, env_changes=changes, seed=seed)
    if not agent.settings.is_arm:
        raise UserError(
            f"collect: {checkpoint} acts in env.kind={agent.settings.env.kind!r}: datasets are gathered from the arm "
            "with one task (env=reach, …)"
        )
    part = part or ("planner" if "planner" in agent.policies else "policy")
    if part not in agent.policies:
        raise UserError(f"collect: policy={part}: {checkpoint} has only {', '.join(agent.policies)}")
    settings = agent.settings
    played = {**settings.values, "env": dict(settings.env.changed(**changes).values)}
    return Gatherer(agent.env, agent.policies[part], played, f"{part} of {checkpoint}", settings.seed)
