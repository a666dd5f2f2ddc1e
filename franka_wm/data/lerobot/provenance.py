"""How a dataset came about; ``meta/franka_wm/provenance.json`` travels with it."""

from __future__ import annotations

import platform
import shlex
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from franka_wm.data.lerobot.schema import PROVENANCE
from franka_wm.errors import UserError
from franka_wm.untrusted import linked_json, values_of

_PACKAGES = ("franka-wm", "torch", "torchrl", "newton", "warp-lang", "lerobot", "numpy")


def describe(
    *, policy: str, seed: int, config: Mapping[str, Any], command: str | None = None, **more: Any
) -> dict[str, Any]:
    """One session of gathering: what is needed to do it again.

    Args:
        policy: Who acted.
        seed: Seed of the run.
        config: The resolved configuration, plain values.
        command: What was typed; this process's command line if not given.
        more: Anything else, plain values.
    """
    return {
        "command": _typed() if command is None else command,
        "policy": policy,
        "seed": seed,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": {"python": platform.python_version()} | {name: _version(name) for name in _PACKAGES},
        "config": dict(config),
        **more,
    }


def _typed() -> str:
    """The command line of this process; as one of several on GPUs it is ``python -m franka_wm``."""
    name = Path(sys.argv[0]).name
    return shlex.join(["franka-wm" if name == "__main__.py" else name, *sys.argv[1:]])


def _ranges(*names: str) -> list[str]:
    return [f"randomization.{name}" for name in names]


ACTIONS = (
    *("action_mode", "action_scale", "ee_scale"),
    *("robot", "urdf_path", "asset_name", "urdf_relative_path"),
)
"""Options that give recorded actions and states their meaning, where they are read."""
MEANING = (
    *("task", "reward", *ACTIONS, "action_penalty", "success_distance", "drawer_opening"),
    *("disc_radius", "disc_spread", "task_options"),
    "terminate_on_success",
)
"""Those that give actions, rewards and ends their meaning."""
DYNAMICS = (
    *("fps", "substeps", "solver", "solver_iterations", "solver_ls_iterations"),
    *("joint_armature", "target_ke", "target_kd", "gravity_compensation", "limit_velocity", "gripper_force"),
    *("collisions", "collision_pipeline", "track_radius", "track_period"),
    # Ranges count as any value does: they say which physics the episodes are of, delays and noise among them. Who wants
    # other ones beside these records a dataset of its own and joins both, dataset.root=[…]. Evaluating, and going on to
    # train, with other ranges is a use (robustness), so what reads a dataset says it and does not refuse it.
    *_ranges("gains", "armature", "friction", "mass", "object_size", "table_height", "contact_friction"),
    *_ranges("grip_force", "action_noise", "action_latency", "observation_noise", "object_noise"),
)
"""Those that change what an action does, and what is observed of that, beside the scene. Where episodes start and how
long they may be (``home``, ``goal_sampling``, ``episode_length``, …) does not; the gripper shows in actions' size."""
VIEWS = (
    *("cameras", "camera_distance", "camera_height", "camera_target_height", "camera_target_distance"),
    *("camera_fov_degrees", "image_size", "show_goal"),
)
"""Those that give images their meaning, beside the robot and the scene: :func:`other_scene`."""
LOOKS = (
    *("enable_shadows", "enable_textures", "finger_opening"),
    *_ranges("color", "brightness", "camera_position", "camera_target"),
)
"""Those that change how the same view looks; not ``mesh_detail``, by default less than a pixel or two."""

BEFORE = {"disc_radius": 0.1, "disc_spread": 0.0, "task_options": None}
"""What recordings had that do not name these options: they were made before there were any."""


def other_option(
    sessions: Iterable[Mapping[str, Any]], env: Mapping[str, Any], names: Iterable[str] = MEANING
) -> tuple[str, Any] | None:
    """The first of :func:`other_options`, if there is one."""
    return next(iter(other_options(sessions, env, names).items()), None)


def other_options(
    sessions: Iterable[Mapping[str, Any]], env: Mapping[str, Any], names: Iterable[str]
) -> dict[str, Any]:
    """Those of these options that sessions were recorded with another value of than ``env`` has, and that value as one
    types it. What is not recorded is not known, and no other.

    Of cameras the first counts: its images have no name that tells it from others.
    """
    names, env, others = [*names], flat(env), {}
    for session in sessions:
        recorded = session.get("config", {}).get("env", {})
        recorded = {**BEFORE, **flat(recorded)} if recorded else recorded
        unread = _unread(recorded) & _unread(env)
        for name in names:
            if name in unread or name not in recorded or name not in env:
                continue
            if _telling(name, recorded) != _telling(name, env):
                others.setdefault(name, as_typed(recorded[name]))
    return others


def told(
    sessions: Sequence[Mapping[str, Any]], env: Mapping[str, Any], *, looks: bool = False
) -> Iterator[str]:
    """Lines about what is other and no reason to refuse reading it: meaning and dynamics; with ``looks`` images."""
    said = {
        MEANING: "its goals, rewards and ends are as recorded",
        DYNAMICS: "what its actions do is as recorded",
    }
    if looks:
        said = {LOOKS: "its images look as recorded"}
    env = flat(env)
    for names, then in said.items():
        if others := other_options(sessions, env, names):
            there = ", ".join(f"env.{name}={value}" for name, value in others.items())
            here = ", ".join(str(as_typed(env[name])) for name in others)
            yield f"recorded with {there}, this run has {here}; {then}"
    same = not looks and not other_scene(sessions, env, images=False)  # else it is refused
    if same and other_scene(sessions, env, images=False, moves=True):
        yield f"recorded with other masses or friction in env.scene; {said[DYNAMICS]}"


def flat(env: Mapping[str, Any]) -> dict[str, Any]:
    """Options by the names that one types, ``randomization.gains`` among them; lists for tuples."""
    drawn = env.get("randomization")
    drawn = drawn if isinstance(drawn, Mapping) else getattr(drawn, "__dict__", {})
    every = {**env, **{f"randomization.{name}": value for name, value in drawn.items()}}
    return {name: [*value] if isinstance(value, tuple) else value for name, value in every.items()}


def as_typed(value: Any) -> Any:
    """A value for a message."""
    from franka_wm.envs.task_options import typed

    return typed(value) if value is None or isinstance(value, Mapping | bool) else value


def _unread(env: Mapping[str, Any]) -> set[str]:
    """Options that do nothing beside others."""
    unread = set() if env.get("action_mode") == "ee_delta" else {"ee_scale"}
    if env.get("solver") == "featherstone":
        unread |= {"solver_iterations", "solver_ls_iterations"}
    if env.get("urdf_path"):
        return unread | {"robot", "asset_name", "urdf_relative_path"}
    return unread if env.get("robot") == "newton_asset" else unread | {"asset_name", "urdf_relative_path"}


def _telling(name: str, env: Mapping[str, Any]) -> Any:
    value = env[name]
    if name == "task_options":
        return _with_defaults(value, env.get("task"))
    if name == "robot" and value == "panda_meshes_full":
        return "panda_meshes"  # the same with every triangle
    if name == "solver" and value == "auto":
        return "mujoco"
    if name == "urdf_path":
        return value and Path(value).name  # a dataset may come from another machine
    if name in ("target_ke", "target_kd") and isinstance(value, list) and value == value[:1] * len(value):
        return (value or [None])[0]  # one number is that of every joint
    return [*value][:1] if name == "cameras" else value


def _with_defaults(options: Mapping[str, Any] | None, task: Any) -> dict[str, Any]:
    """A task's own options with the defaults of those left out, where the task is known here."""
    from franka_wm.envs.tasks import TASKS, task_class

    return {**(task_class(task).option_defaults if task in TASKS else {}), **(options or {})}


def other_scene(
    sessions: Iterable[Mapping[str, Any]], env: Mapping[str, Any], *, images: bool, moves: bool = False
) -> bool:
    """Whether sessions were recorded in a scene of other bodies than that of ``env``, which has ``task`` and ``scene``.

    How they move counts with ``moves`` alone, since it does not show in them. How far their starts are spread does
    not, nor do folders of files, nor colours where no images are read. Scenes whose files or tasks are not known here
    are not compared: a dataset may come from another machine.
    """
    from franka_wm.envs.tasks import TASKS

    for session in sessions:
        recorded = session.get("config", {}).get("env", {})
        if "scene" in recorded and "scene" in env and recorded.get("task", env["task"]) in TASKS:
            try:
                there = _shown(recorded["scene"], recorded.get("task", env["task"]), images, moves)
            except UserError:
                continue
            if there != _shown(env["scene"], env["task"], images, moves):
                return True
    return False


MOVES = ("mass", "friction", "joint_friction", "joint_damping")
"""How a body moves, which no image shows."""
STARTS = ("spread", "turn")
"""How far its start is drawn at random."""
COLOURS = ("color", "case_color")


def _shown(given: Any, task: str, images: bool, moves: bool) -> list[Any]:
    """What a scene's bodies look like, with ``moves`` how they move, and where those that stand still stand; as plain
    values that can be compared."""
    from franka_wm.envs.scene import Body, Scene
    from franka_wm.envs.tasks import task_class

    scene = task_class(task).scene if given is None else Scene.of(given)
    if scene is None:
        return []
    unseen = (*STARTS, *(() if moves else MOVES), *(() if images else COLOURS))
    return [
        (type(one).__name__, {
            field.name: _plain(getattr(one, field.name)) for field in fields(one)
            if field.name not in unseen and not (field.name == "at" and isinstance(one, Body))
        })
        for one in (scene.table, *scene.objects, *scene.articulated, *scene.obstacles)
    ]  # fmt: skip


def _plain(value: Any) -> Any:
    if isinstance(value, str):
        return Path(value).name
    return [_plain(one) for one in value] if isinstance(value, Sequence) else value


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def read_provenance(root: str | Path) -> dict[str, Any] | None:
    """``sessions`` (what :func:`describe` returned, with ``episodes``) and ``schema``; ``None`` for others' datasets.

    Raises:
        UserError: The file cannot be read.
    """
    path = Path(root) / PROVENANCE
    if not path.is_file():
        return None
    return linked_json(path)


def recorded_sessions(root: str | Path) -> list[dict[str, Any]]:
    """What :func:`describe` said of each session of gathering; none for others' datasets.

    Raises:
        UserError: The file cannot be read, or is of a form that nothing here writes.
    """
    with values_of(str(root), "copy or download the dataset again"):
        sessions: list[dict[str, Any]] = list((read_provenance(root) or {}).get("sessions") or ())
        for session in sessions:
            session.get("config", {}).get("env", {}).items()
        return sessions


def recorded_tasks(sessions: Iterable[Mapping[str, Any]]) -> set[str]:
    """Names of the tasks of :func:`recorded_sessions`."""
    return {session.get("config", {}).get("env", {}).get("task") for session in sessions} - {None}
