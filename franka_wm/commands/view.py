"""``franka-wm view``: an arm in the browser, or an episode for the Rerun viewer."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from franka_wm.errors import UserError
from franka_wm.live.page import import_viser
from franka_wm.live.view import Options, build, record, serve

USAGE = """usage: franka-wm view [key=value …]

An arm in the browser, on this machine only: drag its goal, switch policies, move the planner's settings.

  checkpoint=FOLDER   a run's folder, a checkpoint in it, or hf:user/name; without one the arm is moved by
                      a planner that knows its geometry, inverse kinematics, random actions, or not at all
  policy=NAME         who acts first: planner, policy, ik, random, noop
  port=8080           of http://127.0.0.1; 0 takes a free one
  out=FOLDER          where recordings go: videos and LeRobot datasets (the present folder)
  seconds=S           ends after so long; without it, Ctrl-C ends it
  seed=0  device=auto
  env.KEY=VALUE       a field of the environment's configuration; episodes have no end unless
                      env.episode_length is given
  rerun=FILE.rrd      no page: writes one episode for the Rerun viewer (rerun FILE.rrd)"""


def parse(arguments: Sequence[str]) -> Options:
    """``key=value`` arguments as :class:`Options`.

    Raises:
        UserError: An argument that is none of them, or a value that cannot be.
    """
    options = Options()
    known = {f.name for f in fields(Options)}
    numbers: Mapping[str, Callable[[str], Any]] = {"port": int, "seed": int, "seconds": float}
    for argument in arguments:
        key, equals, value = argument.partition("=")
        key = key.lstrip("-")
        if equals and key.startswith("env."):
            try:
                given: Any = OmegaConf.to_container(OmegaConf.from_dotlist([argument]))
                options.env |= given["env"]
            except OmegaConfBaseException as error:
                raise UserError(f"{argument}: {error}") from error
            continue
        if not equals or not value or key == "env" or key not in known:
            raise UserError(
                f"view: {argument!r} is not key=value with a key that it knows; see franka-wm view --help"
            )
        try:
            setattr(options, key, numbers.get(key, str)(value))
        except ValueError as error:
            raise UserError(f"view: {argument}: must be a number") from error
    if not 0 <= options.port <= 65535:
        raise UserError(f"view: port={options.port}: must be from 0 to 65535")
    if options.rerun is not None and not options.rerun.endswith(".rrd"):
        raise UserError(f"view: rerun={options.rerun}: must end in .rrd")
    if options.seconds is not None and not 0 < options.seconds < float("inf"):
        raise UserError(f"view: seconds={options.seconds:g}: must be above 0 and finite")
    return options


def view(arguments: Sequence[str]) -> None:
    """The verb.

    Raises:
        UserError: Bad arguments, a missing extra, or a checkpoint that cannot be shown.
    """
    if any(argument in ("--help", "-h") for argument in arguments):
        print(USAGE)
        return
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING  # its list of compiled modules drowns what there is to say
    options = parse(arguments)
    if options.rerun is not None:
        record(options)
        return
    import_viser()  # before anything that takes time
    serve(build(options), options)
