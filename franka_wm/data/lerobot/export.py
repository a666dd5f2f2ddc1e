"""A replay buffer becomes a dataset."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from franka_wm.data.image_storage import newest
from franka_wm.data.lerobot.episodes import cut_replay, tell_lost
from franka_wm.data.lerobot.hub import check_repo_id
from franka_wm.data.lerobot.paths import without_paths
from franka_wm.data.lerobot.provenance import describe, read_provenance
from franka_wm.data.lerobot.schema import schema_for
from franka_wm.data.lerobot.writer import DatasetWriter
from franka_wm.errors import UserError
from franka_wm.untrusted import values_of

if TYPE_CHECKING:
    from tensordict import TensorDictBase

    from franka_wm.envs import FrankaConfig


@dataclass(frozen=True)
class Exported:
    """What became of a replay.

    Attributes:
        out: The dataset.
        episodes, frames: In it.
        partial: Episodes of which the buffer holds only a part; they were left out.
    """

    out: Path
    episodes: int
    frames: int
    partial: int


def tell(done: Exported) -> None:
    """Says what was written and what was not."""
    from franka_wm.console import say

    left = f"; {done.partial} partial episodes in the buffer were left out" if done.partial else ""
    say(f"dataset: {done.out}   {done.episodes} episodes, {done.frames} steps{left}")


def arm_config(settings: Mapping[str, Any]) -> FrankaConfig:
    """The arm's config in a run's resolved configuration.

    Raises:
        UserError: The run gathered nothing, or not with the arm and one task.
    """
    from franka_wm.envs import FrankaConfig

    env = dict(settings["env"])
    kind = env.pop("kind")
    if (settings.get("dataset") or {}).get("kind", "none") != "none":
        raise UserError(
            "export: the run learned from recorded episodes and gathered none; those are a dataset"
        )
    if kind == "multitask":
        raise UserError("export: the run has several tasks at once (env=multitask); a dataset is of one task")
    if kind != "franka":
        raise UserError("export: the run's environment is not the arm; there is no schema for its data")
    env.pop("urdf_path", None)
    return FrankaConfig.from_mapping(env)


def export_replay(
    data: TensorDictBase,
    *,
    config: FrankaConfig,
    out: str | Path,
    seed: int,
    policy: str,
    settings: Mapping[str, Any],
    format: str = "exact",
    workers: int = 2,
) -> Exported:
    """Writes the whole episodes of a replay.

    A replay keeps what its model reads, so a dataset may have fewer features than one that was collected. Where the
    goal is not kept, it follows from ``state``, within the rounding of one subtraction; success follows where it is
    the tool's distance to the goal, and is left out of other tasks' datasets.

    Args:
        data: (worlds, time), oldest step first: observations, ``action``, ``is_init`` and, under ``next``,
            observations, ``reward``, ``terminated``, ``truncated`` and ``success`` if they are there.
        config: The environment's.
        out, format, workers: As for :class:`~franka_wm.data.lerobot.writer.DatasetWriter`.
        seed: Seed of the run.
        policy, settings: Who acted, and the resolved configuration, for the provenance.

    Each process of a job calls this with its own worlds; the dataset has the episodes of all.

    Returns:
        What became of all of it.

    Raises:
        UserError: There is no whole episode, or it cannot be written.
    """
    from franka_wm import processes
    from franka_wm.console import say
    from franka_wm.envs.discretize import discrete_action_table
    from franka_wm.envs.tasks import goal_distance, make_task

    if config.frame_stack > 1:  # a replay keeps each image once, and so does a dataset
        stacked = [str(key) for key in data.keys() if str(key).startswith(("pixels", "goal_pixels"))]  # noqa: SIM118
        data, config = newest(data, stacked, config.frame_stack), replace(config, frame_stack=1)
    after = data.get("next")
    if "truncated" not in after.keys() and config.num_objects and config.end_when_lost:  # noqa: SIM118
        say(
            "export: this replay does not say which episodes were cut short, so those that lost an object are missing; "
            "a run with export=lerobot keeps them"
        )
    known = ("state", "joint_target", "objects", "contacts", "goal")
    keys = [key for key in data.keys() if key in known or str(key).startswith(("pixels", "goal_pixels"))]  # noqa: SIM118
    keys = [str(key) for key in keys if key in after.keys()]  # noqa: SIM118
    data, after = data.clone(recurse=False), after.clone(recurse=False)
    if "state" in keys and "goal" not in keys:
        for part in (data, after):
            state = part.get("state")
            part.set("goal", state[..., 14:17] - state[..., 17:20])
        keys.append("goal")
    within = make_task(config).success_distance
    if within is not None and "state" in keys and "success" not in after.keys():  # noqa: SIM118
        after.set("success", goal_distance(after.get("state")).unsqueeze(-1) < within)
    data.set("next", after)
    schema = schema_for(config, format=format, keys=keys, success="success" in after.keys())  # noqa: SIM118
    discrete = None
    if not data.get("action").is_floating_point():
        discrete = discrete_action_table(config.action_dim, gripper=config.has_gripper)
    episodes, partial, lost = cut_replay(
        data,
        schema,
        seed=seed,
        episode_length=config.episode_length,
        first_world=processes.rank() * len(data),
        discrete=discrete,
    )
    counts = processes.objects((len(episodes), sum(e.length for e in episodes), partial, lost))
    whole, frames, partial, lost = (sum(one) for one in zip(*counts, strict=True))
    tell_lost("export", lost)
    if not whole:
        raise UserError(
            f"export: the buffer holds no whole episode of {config.episode_length} steps, only {partial} partial "
            "ones; gather more first"
        )
    provenance = describe(policy=policy, seed=seed, config=settings)
    with DatasetWriter(out, schema, provenance=provenance, workers=workers, resumable=False) as writer:
        writer.add(episodes)
        return Exported(writer.finish(), whole, frames, partial)


def export_run(
    settings: Mapping[str, Any], data: TensorDictBase | None, *, folder: Path, actor: str
) -> Exported | None:
    """The end of a training run: what ``export`` in its configuration asks for. Each process of a job calls this.

    A run that goes on, and had written its dataset before, does not write it again, nor publish it again.

    Args:
        settings: The run's resolved configuration, plain; ``export`` has ``kind`` (none, lerobot), ``out`` (``None``:
            ``dataset`` in the run's folder), ``format``, ``workers`` and ``repo_id`` (published there if given).
        data: The replay, oldest step first; ``None`` if there is none.
        folder: Folder of the run.
        actor: The policy that gathered; ``auto`` in the configuration names none.

    Returns:
        What became of it; ``None`` if nothing was written.
    """
    from franka_wm import processes
    from franka_wm.console import say

    wanted = settings["export"]
    if wanted["kind"] == "none":
        return None
    out, done = Path(wanted["out"] or folder / "dataset"), None
    if processes.objects(processes.is_first() and written_before(settings, out))[0]:
        say(f"dataset: {out} was written before")
    elif data is None:
        raise UserError(
            "export=lerobot: this run has gathered nothing"
            + ("; export the dataset that it was trained on" if settings.get("resume") is None else _NOT_KEPT)
        )
    else:
        done = export_replay(
            data,
            config=arm_config(settings),
            out=out,
            seed=int(settings["seed"]),
            policy=f"{actor} in a training run",
            settings=settings,
            format=wanted["format"],
            workers=int(wanted["workers"]),
        )
        tell(done)
    if wanted["repo_id"] and processes.is_first():
        from franka_wm.data.lerobot.publish import publish_dataset, published_before

        repo_id = wanted["repo_id"]
        if settings.get("resume") is not None and published_before(
            repo_id, partial(_is_published_of, settings, repo_id)
        ):
            say(f"dataset: {repo_id} was published before")
        else:
            publish_dataset(out, repo_id)
    return done


_NOT_KEPT = (
    ", and the checkpoint was saved without experience; begin it again in another folder, "
    "with trainer.checkpoint_replay=true"
)


def written_before(settings: Mapping[str, Any], out: Path) -> bool:
    """Whether the run that this one goes on with ended after it had written the dataset ``out``.

    Raises:
        UserError: What is there cannot be read.
    """
    if settings.get("resume") is None or not out.exists():
        return False
    with values_of(str(out), "choose another export.out"):
        found = read_provenance(out)
        return found is not None and _is_of(settings, found)


def _is_of(settings: Mapping[str, Any], provenance: Mapping[str, Any]) -> bool:
    """Whether the run of these settings has made the dataset of this provenance."""
    here = json.loads(json.dumps(dict(settings)))
    return [_alike(session["config"]) for session in provenance["sessions"]] == [_alike(here)]


def _is_published_of(settings: Mapping[str, Any], repo_id: str, provenance: Mapping[str, Any]) -> bool:
    """The same of a published provenance, of whose paths only the last parts are left."""
    with values_of(repo_id, "choose another export.repo_id"):
        return _is_of(without_paths(dict(settings)), without_paths(provenance))


def _alike(config: Mapping[str, Any]) -> dict[str, Any]:
    """What of a run's configuration stays as it goes on. A checkpoint's model says more: what it was built with."""
    kept = {key: value for key, value in config.items() if key not in ("resume", "plugins", "device", "gpus")}
    export = {key: value for key, value in config["export"].items() if key != "repo_id"}  # where, not what
    return kept | {"model": config["model"]["name"], "export": export}


def check_export(settings: Mapping[str, Any]) -> None:
    """What can be refused before a run starts.

    Raises:
        UserError: One line.
    """
    wanted = settings["export"]
    schema_for(replace(arm_config(settings), frame_stack=1), format=wanted["format"])
    if wanted["repo_id"]:
        from franka_wm.data.lerobot.publish import hub_client

        try:
            check_repo_id(wanted["repo_id"])
            hub_client(wanted["repo_id"])
        except UserError as error:
            raise UserError(f"export.repo_id={wanted['repo_id']}: {error}") from error
    if wanted["out"]:
        check_export_place(settings, Path(wanted["out"]))


def check_export_place(settings: Mapping[str, Any], out: Path) -> None:
    """Refuses a dataset that is there, unless the run that this one goes on with has written it.

    Raises:
        UserError: One line.
    """
    if out.exists() and not written_before(settings, out):
        raise UserError(
            f"export.out={out} exists, from another run or from this one with other options; choose another folder"
        )
