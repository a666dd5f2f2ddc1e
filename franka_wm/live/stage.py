"""One world and who can act in it, shown in the browser or recorded for the Rerun viewer."""

from __future__ import annotations

import gc
import os
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from franka_wm.console import announced, say
from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.errors import UserError
from franka_wm.interrupt import INTERRUPTED
from franka_wm.live.commanded import kinematic_planner
from franka_wm.options import check_whole
from franka_wm.policies.expert import ExpertPolicy
from franka_wm.policies.scripted import IKPolicy, NoopPolicy, SmoothRandomPolicy
from franka_wm.training.load import find_checkpoint, load_agent

ARM: dict[str, Any] = {
    "observations": ("state", "joint_target"),
    "goal_sampling": "reachable",
    "action_scale": 0.085,
    "limit_velocity": True,
    "gravity_compensation": True,
    "substeps": 4,
}
"""Without a checkpoint: what ``env=reach`` sets. Repeated here: this room does not read the configuration; a test
holds both to the same."""

GRACE = 1.0
"""After Ctrl-C the process ends within this time [s]."""

ENDLESS = {"episode_length": 1_000_000, "terminate_on_success": False}
"""While somebody watches, an episode ends when they ask for another."""

EPISODE = 50
"""Steps of a recorded episode where neither a checkpoint nor the command line says how many."""


@dataclass
class Options:
    """What to show, and how.

    Attributes:
        checkpoint: A run's folder, a checkpoint, or ``hf:user/name``; ``None``: the arm without an agent.
        policy: Who acts first.
        port: Port of the page on this machine; 0 takes a free one.
        out: Where recordings go.
        seconds: Ends after so long.
        seed, device: Seed and device of the world.
        rerun: File for the Rerun viewer instead of a page.
        env: Fields of the environment's configuration to change.
    """

    checkpoint: str | None = None
    policy: str | None = None
    port: int = 8080
    out: str = "."
    seconds: float | None = None
    seed: int = 0
    device: str = "auto"
    rerun: str | None = None
    env: dict[str, Any] = field(default_factory=dict)


@dataclass
class Stage:
    """One world and who can act in it.

    Attributes:
        env: One world, whose episodes have no end unless the command line gives one.
        policies: By name.
        title: What acts, in a few words.
        steps: Length of an ordinary episode.
    """

    env: Any
    policies: dict[str, Any]
    title: str
    steps: int


def build(options: Options) -> Stage:
    """What the command line asks for.

    Raises:
        UserError: A checkpoint that cannot be loaded, or one of another environment.
    """
    changes = {**ENDLESS, **options.env}
    if options.checkpoint is not None:
        check_arm(options.checkpoint)
    with announced("building the arm; on a machine's first start this compiles kernels for a minute or two"):
        if options.checkpoint is None:
            return untrained(options, changes)
        agent = load_agent(
            options.checkpoint, num_envs=1, device=options.device, env_changes=changes, seed=options.seed
        )
    title = f"{agent.settings.model.name}, {int(agent.counters.get('updates', 0)):,} updates"
    return Stage(agent.env, agent.policies, title, agent.settings.env.episode_length)


def check_arm(checkpoint: str) -> None:
    """Whether a checkpoint acts with the arm; only its configuration is read.

    Raises:
        UserError: It does not, or there is none.
    """
    kind = find_checkpoint(checkpoint).config["env"]["kind"]
    if kind != "franka":
        what = "recorded data alone" if kind == "none" else f"another environment ({kind})"
        raise UserError(f"view: {checkpoint}: was trained on {what}; the live page shows the arm only")


def untrained(options: Options, changes: Mapping[str, Any]) -> Stage:
    """The arm without a checkpoint."""
    fields = {**ARM, **changes}
    urdf_path = fields.pop("urdf_path", None)
    config = FrankaConfig.from_mapping(fields)
    if config.object_dim and "objects" not in config.observations:  # what the expert reads
        config = replace(config, observations=(*config.observations, "objects"))
    env = FrankaEnv(config, num_envs=1, device=options.device, seed=options.seed, urdf_path=urdf_path)
    policies: dict[str, Any] = {}
    task = env.simulation.task
    if config.has_gripper:
        fits = config.gravity_compensation and config.action_mode != "ee_delta"
        able = task.expert is not None and "joint_target" in config.observations
        if able and (fits or options.policy == "expert"):  # who asks for it is told why it cannot act
            policies = {"expert": ExpertPolicy(task, env.kinematics, config)}
    elif "joint_target" in config.observations:
        policies = {"planner": kinematic_planner(env), "ik": IKPolicy(env.kinematics, config)}
    policies |= {"random": SmoothRandomPolicy(env.action_dim)}
    if {*(noop := NoopPolicy.of(env)).in_keys} <= {"is_init", *config.observations}:
        policies |= {"noop": noop}
    title = "planning with exact geometry" if "planner" in policies else config.task_class.words
    return Stage(env, policies, title, EPISODE)


def record(options: Options) -> None:
    """Writes one episode for the Rerun viewer."""
    from franka_wm.live.rerun_recording import record_episode

    assert options.rerun is not None
    length = options.env.pop(
        "episode_length", None
    )  # of the recording; the world itself must not restart in it
    if length is not None:
        check_whole("env.episode_length", length, most=ENDLESS["episode_length"], unit="control steps")
    stage = build(options)
    steps = stage.steps if length is None else length
    if options.seconds is not None:
        steps = max(1, round(options.seconds * stage.env.config.fps))
    with announced(f"recording {steps} steps"):
        record_episode(
            stage.env, stage.policies, options.rerun, policy=options.policy, seed=options.seed, steps=steps
        )
    say(f"look at it with: rerun {options.rerun}")


def serve(stage: Stage, options: Options) -> None:
    """Serves the page until the time is up or Ctrl-C."""
    from franka_wm.live.page import Page
    from franka_wm.live.session import Session

    session = Session(stage.env, stage.policies, policy=options.policy, seed=options.seed)
    page = Page(session, port=options.port, folder=options.out, title=stage.title)
    gc.freeze()  # what is built stays: the collections after clients have left need not look through it
    gc.collect()
    try:
        taken = f" (port {options.port} cannot be had)" if options.port not in (0, page.port) else ""
        say(f"{page.address}{taken}   Ctrl-C ends it")
        session.play()
        end = float("inf") if options.seconds is None else time.monotonic() + options.seconds
        while time.monotonic() < end and session.error is None:
            time.sleep(min(0.2, max(0.0, end - time.monotonic())))
        try:
            if session.recording:
                say(f"recorded until now: {page.save_recording()}")
        except UserError as error:
            say(f"the recording was not saved: {error}")
        page.close()
    except KeyboardInterrupt:  # the way to end it, also while a long decision or a slow disk holds a thread
        hurry = threading.Timer(GRACE, os._exit, (INTERRUPTED,))
        hurry.daemon = True
        hurry.start()
        if session.recording:
            say("a recording was not saved: Stop and save comes before Ctrl-C")
        page.close(timeout=0.3 * GRACE)
        if session.error is None:
            sys.stdout.flush()
            # Python would wait for threads, and take seconds to free what the simulator holds.
            os._exit(INTERRUPTED)
        hurry.cancel()
    finally:
        gc.unfreeze()
    if session.error is not None:
        raise session.error
