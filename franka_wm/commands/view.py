"""``franka-wm view``: an arm in the browser, or an episode for the Rerun viewer."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from franka_wm.commands.arguments import check_run, plugins, real, verb, whole, word
from franka_wm.errors import UserError
from franka_wm.files import unwritable
from franka_wm.live.extras import import_rerun, import_viser
from franka_wm.options import did_you_mean
from franka_wm.policies.names import POLICIES, refuse_old_name

if TYPE_CHECKING:
    from franka_wm.live.stage import Options


@verb(
    "view",
    others=("env.", "hydra.searchpath="),
    shown=(
        "env.KEY=VALUE",
        "a field of the environment's configuration; episodes have no end unless env.episode_length is given",
    ),
)
@word("checkpoint", "a run's folder, a checkpoint in it, or hf:user/name", metavar="FOLDER")
@word("env", "without a checkpoint: an arm and its task, as train.py names them", metavar="lift")
@word("policy", "who acts first: planner, policy, ik, expert, random, noop", metavar="NAME")
@word("port", "of http://127.0.0.1; 0 takes a free one", whole(0, 65535), 8080)
@word("out", "where recordings go: videos and LeRobot datasets", default=".")
@word("seconds", "ends after so long; without it, Ctrl-C ends it", real(above=0), metavar="S")
@word("seed", "of the world", whole(), 0)
@word("device", "auto, cpu, cuda, cuda:K", default="auto")
@word("rerun", "no page: writes one episode for the Rerun viewer", metavar="FILE.rrd")
@plugins
def view(**options: Any) -> None:
    """Show an arm in the browser. Drag its goal, switch policies, move the planner's settings.

    The page is served to this machine only.

    Without a checkpoint the arm is moved by a planner that knows its geometry, by inverse kinematics, with a gripper
    by the task's expert, by random actions, or not at all.
    """
    show(**options)


def show(**given: Any) -> None:
    """Serve the page, or record an episode.

    Raises:
        UserError: A bad value, a missing extra, or a checkpoint that cannot be shown.
    """
    if given.get("checkpoint") is not None:  # before anything that takes time
        check_run("view", "checkpoint", given["checkpoint"])
    refuse_old_name("view: policy", given.get("policy"))
    if given.get("policy") not in (None, *POLICIES):
        near = did_you_mean(given["policy"], POLICIES)
        raise UserError(f"view: policy={given['policy']}: must be one of {', '.join(POLICIES)}{near}")
    options = options_of(**given)
    from franka_wm.live.stage import build, record, serve

    if options.rerun is not None:
        record(options)
    else:
        serve(build(options), options)


def options_of(
    overrides: Sequence[str],
    rerun: str | None,
    env: str | None = None,
    checkpoint: str | None = None,
    **given: Any,
) -> Options:
    """The words of the verb as options; what they need is looked at before the simulator is imported.

    Args:
        overrides: ``env.KEY=VALUE`` …, and ``hydra.searchpath=`` where ``env`` is of one's own.
        rerun: File for the Rerun viewer.
        env: Name of an environment of train.py.
        checkpoint: Where an agent is, which has an environment of its own.
        given: The other fields of the options.

    Raises:
        UserError: A value that cannot be, or a missing extra.
    """
    from franka_wm.commands.overrides import changes

    if rerun is not None and not rerun.endswith(".rrd"):
        raise UserError(f"view: rerun={rerun}: must end in .rrd")
    if rerun is not None and (why := unwritable(Path(rerun).parent)) is not None:
        raise UserError(f"view: rerun={rerun}: {why}; choose another place")
    paths = [one for one in overrides if one.startswith("hydra.searchpath=")]
    own = [one for one in overrides if one not in paths]
    fields = _named(env, checkpoint, paths) | changes("view", own).get("env", {})
    if rerun is None:
        import_viser()
    else:
        import_rerun()
    from franka_wm.live.stage import Options

    return Options(rerun=rerun, checkpoint=checkpoint, env=fields, **given)


def _named(env: str | None, checkpoint: str | None, paths: Sequence[str]) -> dict[str, Any]:
    """Fields of the environment that a name of train.py stands for; none without a name."""
    if env is None:
        return {}
    if checkpoint is not None:
        raise UserError(
            f"view: env={env}: the checkpoint has its own environment; change it by env.KEY=VALUE"
        )
    from omegaconf import OmegaConf

    from franka_wm.commands.overrides import compose

    values: Any = OmegaConf.to_container(compose([f"env={env}", *paths]).env, resolve=True)
    if values.pop("kind") != "franka":
        raise UserError(f"view: env={env}: the page shows the arm only")
    if values["urdf_path"] is None:
        del values["urdf_path"]
    del values["episode_length"]  # while somebody watches, an episode has no end
    images = [key for key in values["observations"] if "pixels" in key]
    return values | {"observations": [key for key in values["observations"] if key not in images]}
