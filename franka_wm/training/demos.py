"""Demonstrations for a run, from the datasets that ``replay.demos`` names."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tensordict import TensorDict
from torch.nn import functional as F

from franka_wm.console import say
from franka_wm.data.demonstrations import Demonstrations
from franka_wm.data.hindsight import Hindsight
from franka_wm.data.image_storage import BOUNDARY
from franka_wm.device import resolve_device
from franka_wm.envs import Environment
from franka_wm.envs.config import FrankaConfig
from franka_wm.envs.multitask_config import MultiTaskConfig
from franka_wm.envs.simulation.demonstrated import READS
from franka_wm.envs.task_options import typed
from franka_wm.envs.transformed import arm_of
from franka_wm.errors import UserError
from franka_wm.training.settings import RunSettings
from franka_wm.training.spaces import Spaces

UNSEEN = ("object_size", "table_height", "observation_noise", "object_noise", "action_latency")
"""Randomization that is not in what is observed, or hides it: states cannot be restored from that."""


def open_demonstrations(
    run: RunSettings, spaces: Spaces, hindsight: Hindsight | None
) -> Demonstrations | None:
    """The episodes that ``run.replay.demos`` names, on the run's device; ``None`` where it names none.

    Args:
        spaces: Those of the environment, which need not be there yet.

    Raises:
        UserError: They cannot be read, or have other observations or fewer steps than the run, or no rewards.
    """
    if run.replay.demos is None:
        return None
    read = spaces.only(run.model.observations, f"model={run.model.name}")
    vectors = {*read.observation_sizes, *(() if hindsight is None else hindsight.reads)}
    wanted: dict[str, Any] = {key: spaces.observation_sizes[key] for key in sorted(vectors)} | dict(
        read.image_sizes
    )
    starts = READS if run.replay.demo_resets else ()
    if isinstance(run.env.config, MultiTaskConfig):
        steps = _of_tasks(run, run.env.config, wanted, spaces.action_dim)
    else:
        steps = _recorded(run, run.replay.demos, wanted, spaces.action_dim, starts)
    say(told(run))
    most = max(run.demo_windows(update) for update in (0, run.replay.demo_updates, run.trainer.updates))
    return Demonstrations(
        steps.exclude(*(key for key in starts if key not in wanted)),
        window=run.window,
        burn_in=run.burn_in,
        most=most,
        hindsight=hindsight,
        states=steps.select(*starts).squeeze(1) if starts else None,
    )


def told(run: RunSettings) -> str:
    """How much of what is learned from are demonstrations, for whoever watches."""
    replay = run.replay
    begin, end = replay.demo_share, replay.demo_share_end
    falling = "" if end is None or end == begin else f", {100 * end:.0f} % at the last update"
    alone = f"; the first {replay.demo_updates} updates see them alone" if replay.demo_updates else ""
    return f"demonstrations: {100 * begin:.0f} % of each batch{falling}{alone}"


def _recorded(
    run: RunSettings, roots: Any, wanted: Mapping[str, Any], action_dim: int, starts: Sequence[str] = ()
) -> Any:
    """Transitions (T, 1) of these datasets, on the run's device: what is `wanted`, key -> size, and `starts`."""
    from franka_wm.data.lerobot import open_dataset

    recorded = open_dataset(
        roots,
        window=1,
        batch_size=1,
        device=resolve_device(run.device),
        validation_fraction=0.0,
        keys=list({**wanted, **dict.fromkeys(starts)}),
        frame_stack=run.env.frame_stack,
        action_dim=action_dim,
    )
    there, given = {**recorded.observation_sizes, **recorded.image_sizes}, f"replay.demos={roots}"
    sizes = dict(wanted)
    if starts:
        arm = run.env.arm
        sizes |= zip(READS, (arm.state_dim, arm.target_dim, arm.object_dim, 3), strict=True)
    for key, size in sizes.items():
        if there[key] != size:
            raise UserError(
                f"{given}: {key} has size {there[key]} there, {size} in this environment; record it with its options"
            )
    if recorded.reward_bounds is None:
        raise UserError(f"{given}: these episodes have no rewards; record them with franka-wm collect")
    keys = [*wanted, "action", "is_init", *(("next", key) for key in (*wanted, "reward", "terminated"))]
    return TensorDict.cat([one.select(*keys, *starts) for one in recorded.batches(4096)])


def _of_tasks(run: RunSettings, config: MultiTaskConfig, wanted: Mapping[str, int], action_dim: int) -> Any:
    """Transitions (T, 1) of several tasks, as :class:`~franka_wm.envs.multitask.MultiTaskEnv` shows them: with zeros
    where a task has less, and `task` one-hot."""
    parts = []
    names = list(config.tasks)
    for name, roots in _by_task(run, config).items():
        own = Spaces.of_config(config.tasks[name])
        has = {key: own.observation_sizes[key] for key in wanted if key in own.observation_sizes}
        steps = _recorded(run, roots, has, own.action_dim)
        begins = steps[BOUNDARY].flatten().nonzero().flatten()
        longest = int(begins.diff(append=begins.new_tensor([len(steps)])).max())
        if longest < run.window:
            raise UserError(
                f"replay.demos: no demonstration of {name} has {run.window} steps, as the windows of this run"
            )
        one_hot = steps["action"].new_zeros(*steps.batch_size, len(names))
        one_hot[..., names.index(name)] = 1.0
        for part in (steps, steps["next"]):
            for key, size in wanted.items():
                there = one_hot if key == "task" else part.get(key, one_hot[..., :0])
                part.set(key, F.pad(there, (0, size - there.shape[-1])))
        parts.append(steps.set("action", F.pad(steps["action"], (0, action_dim - own.action_dim))))
    return TensorDict.cat(parts)


def _by_task(run: RunSettings, config: MultiTaskConfig) -> dict[str, list[str]]:
    """Task -> the datasets of ``run.replay.demos`` that were recorded in it.

    Raises:
        UserError: One was recorded in none of them.
    """
    from franka_wm.data.lerobot.provenance import MEANING, other_option, recorded_sessions, recorded_tasks
    from franka_wm.data.lerobot.source import read_source

    demos, found = run.replay.demos, {}
    for root in (demos,) if isinstance(demos, str) else demos or ():
        with _as_demos():
            source = read_source(Path(root))
        sessions = recorded_sessions(source.root)
        tasks = recorded_tasks(sessions)
        fitting = [name for name, one in config.tasks.items() if tasks == {one.task}]
        if not fitting:
            what = f"env.task={tasks.pop()}" if len(tasks) == 1 else "no single task of this package"
            raise UserError(
                f"replay.demos={root}: was recorded in {what}; with env=multitask give datasets of its tasks, one or "
                f"more for each that shall have some: {', '.join(config.tasks)}"
            )
        # Of several entries with this task the one whose options it was recorded with; what is refused names the first.
        alike = [
            name for name in fitting if other_option(sessions, vars(config.tasks[name]), MEANING) is None
        ]
        found.setdefault((alike or fitting)[0], []).append(root)
    return found


def start_along(env: Environment, shown: Demonstrations, share: float) -> None:
    """Lets a share of the episodes that the arm's worlds begin from now on start in a demonstrated state."""
    arm = arm_of(env)
    assert arm is not None and shown.states is not None
    begins = shown.transitions.get(BOUNDARY).flatten()
    arm.simulation.start_along(shown.states, begins, share)
    shown.states = None  # the simulation has its own


def check_demonstrations(run: RunSettings) -> None:
    """Refuses demonstrations whose actions, rewards or images mean something else, as far as their datasets say it.

    Raises:
        UserError: One line.
    """
    share = run.replay.demo_resets
    if share and run.env.kind == "multitask":
        raise UserError(
            f"replay.demo_resets={share}: episodes of env=multitask do not begin along demonstrations; leave it at 0"
        )
    if share and not (run.is_arm and run.env.arm.has_gripper):
        raise UserError(
            f"replay.demo_resets={share}: is for tasks with a gripper, such as env=stack; leave it at 0"
        )
    if not share and not any(run.demo_windows(update) for update in (0, run.trainer.updates)):
        raise UserError(
            f"replay.demo_share={run.replay.demo_share}: no update would see replay.demos; give them a share, "
            "demo_updates or demo_resets"
        )
    if isinstance(run.env.config, MultiTaskConfig):
        for name, roots in _by_task(run, run.env.config).items():
            _check_recorded(run, roots, run.env.config.tasks[name], f"env.tasks.{name}")
    else:
        _check_recorded(run, run.replay.demos, run.env.arm if run.is_arm else None, "this run")


def _check_recorded(run: RunSettings, roots: Any, arm: FrankaConfig | None, whose: str) -> None:
    """The same of datasets of one task, that of `arm`; `whose` it is, for what is refused."""
    from franka_wm.data.lerobot.opening import read_datasets
    from franka_wm.data.lerobot.provenance import (
        MEANING,
        VIEWS,
        other_option,
        other_scene,
        recorded_sessions,
    )
    from franka_wm.data.lerobot.provenance import told as told_of

    share = run.replay.demo_resets
    if arm is not None and share:
        _check_seen(share, "run", vars(arm.randomization))
    with _as_demos():
        sources, mappings = read_datasets(
            roots, normalize_actions=False, fps=arm and arm.fps, action_dim=arm and arm.action_dim
        )
    if not all(one.ours for one in mappings):
        others = next(s.root for s, one in zip(sources, mappings, strict=True) if not one.ours)
        raise UserError(
            f"replay.demos={others}: was not recorded by this package, so its actions would be scaled to [−1, 1] and "
            "mean something else; "
            + ("only the arm has demonstrations" if arm is None else "record them with franka-wm collect")
        )
    if arm is None:
        return
    env = {**vars(arm), "urdf_path": run.env.urdf_path}
    own = Spaces.of_config(arm)
    read = {*(run.model.observations or own.observation_sizes)}
    looks = read & {*own.image_sizes}
    for source, one in zip(sources, mappings, strict=True):
        lacking = sorted((read & {*own.observation_sizes, *own.image_sizes}) - {*one.images, *one.vectors})
        if lacking:
            raise UserError(
                f"replay.demos={source.root}: has no {' nor '.join(lacking)}, which model={run.model.name} reads; "
                f"record it with all that {whose} observes"
            )
        sessions = recorded_sessions(source.root)
        for session in sessions if share else ():
            recorded = session.get("config", {}).get("env", {})
            _check_seen(share, "dataset", recorded.get("randomization", {}))
        changed = other_option(sessions, env, (*MEANING, *VIEWS) if looks else MEANING)
        if changed is not None:
            name, there = changed
            raise UserError(
                f"replay.demos={source.root}: recorded with env.{name}={there}, {whose} has {typed(env[name])}"
            )
        if other_scene(sessions, env, images=bool(looks)):
            raise UserError(
                f"replay.demos={source.root}: recorded with another env.scene, whose objects are other ones"
            )
        for line in (*told_of(sessions, env), *(told_of(sessions, env, looks=True) if looks else ())):
            say(f"replay.demos={source.root}: {line}")


@contextmanager
def _as_demos() -> Iterator[None]:
    """Lines about a dataset inside name the option that these were given by."""
    try:
        yield
    except UserError as error:
        raise UserError(str(error).replace("dataset.root=", "replay.demos=")) from error


def _check_seen(share: float, where: str, drawn: Mapping[str, Any]) -> None:
    """Refuses randomization without which a demonstrated state is another one."""
    unseen = next((name for name in UNSEEN if drawn.get(name)), None)
    if unseen is not None:
        raise UserError(
            f"replay.demo_resets={share}: this {where} has env.randomization.{unseen}={drawn[unseen]}, which no "
            "observation shows; leave one of them at 0"
        )
