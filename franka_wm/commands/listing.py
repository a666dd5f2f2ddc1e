"""``franka-wm list``: what can be named in a configuration. Without plugins it reads files alone."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Sequence
from pathlib import Path

from franka_wm.commands.arguments import listed, verb, word
from franka_wm.errors import UserError
from franka_wm.untrusted import linked_json

# The values of FrankaConfig.robot, which lives in a package that imports the simulator.
ROBOTS = {
    "embedded": "FR3 drawn with primitives; ships with the package",
    "newton_asset": "FR3 with meshes, downloaded by Newton; needs the extra [meshes]",
    "panda_meshes": "Panda with thinned-out meshes; needs the extra [meshes]",
    "panda_meshes_full": "the same with every triangle, for close-ups",
    "urdf": "a URDF of your own: urdf_path=…",
}

PACKAGE = Path(__file__).parents[1]


@verb(
    "list",
    others="hydra.searchpath=",
    shown=("hydra.searchpath=[file://FOLDER]", "configuration groups of your own, as for train"),
)
@word("plugins", "also what these modules of your own register, as for train", metavar="[MODULE,…]")
def show_list(plugins: str | None, overrides: Sequence[str]) -> None:
    """List what can be chosen. Environments, models, planners, experiments and more, each with a line.

    Datasets are those below ./datasets.
    """
    folders = [PACKAGE / "conf"]
    folders += [
        Path(one.removeprefix("file://")) for word in overrides for one in listed(word.partition("=")[2])
    ]
    for folder in folders:
        if not folder.is_dir():
            raise UserError(f"list: hydra.searchpath: {folder} is not a folder")
    sections = {
        "environments (env=)": options("env", folders),
        "robots (env.robot=)": ROBOTS | options("env/robot", folders),
        "tasks (env.task=)": tasks(),
        "models (model=)": options("model", folders),
        "planners (planner=)": options("planner", folders),
        "pretraining (pretrain=)": options("pretrain", folders),
        "recorded data (dataset=)": options("dataset", folders),
        "datasets (dataset=lerobot dataset.root=)": datasets(Path("datasets")),
        "scales (scale=)": options("scale", folders),
        "experiments (experiment=)": options("experiment", folders),
    }
    if plugins is not None:
        sections |= registered(listed(plugins))
    for title, entries in sections.items():
        if entries:
            print(title)
        for name, line in entries.items():
            print(f"  {name:24s} {line}".rstrip())


def options(group: str, folders: Sequence[Path] = (PACKAGE / "conf",)) -> dict[str, str]:
    """The options of a configuration group: file name → its first comment line."""
    files = sorted(file for folder in folders for file in (folder / group).glob("*.yaml"))
    return {file.stem: _first_comment(file) for file in files}


def registered(plugins: Sequence[str]) -> dict[str, dict[str, str]]:
    """What modules of the user's register: title → name → line."""
    from franka_wm import models
    from franka_wm.envs import tasks
    from franka_wm.envs.robots.sources import SOURCES
    from franka_wm.planning import registry
    from franka_wm.training.run import import_plugins

    def known() -> dict[str, dict[str, str]]:
        of_tasks = {name: inspect.getdoc(tasks.task_class(name)) or "" for name in tasks.TASKS}
        return {
            "models of your plugins (model.name=)": models.available(),
            "planners of your plugins (planner.name=)": registry.available(),
            "tasks of your plugins (env.task=)": {
                name: text.split("\n")[0] for name, text in of_tasks.items()
            },
            "robots of your plugins (env.robot=)": {
                name: (inspect.getdoc(one.find) or "").split("\n")[0] for name, one in SOURCES.items()
            },
        }

    before = known()
    import_plugins(plugins)
    return {
        title: {name: line for name, line in entries.items() if name not in before[title]}
        for title, entries in known().items()
    }


def datasets(folder: Path) -> dict[str, str]:
    """LeRobot datasets one level below a folder: path → what is in it."""
    found = {}
    for file in sorted(folder.glob("*/meta/info.json")):
        try:
            info = linked_json(file)
            line = f"{info['total_episodes']:,} episodes, {info['total_frames']:,} steps"
        except (UserError, KeyError, TypeError, ValueError) as error:
            line = f"{file.relative_to(file.parents[1])} cannot be read ({error!r})"
        found[str(file.parents[1])] = line
    return found


def _first_comment(file: Path) -> str:
    for line in file.read_text(encoding="utf-8").splitlines():
        if line.startswith("# @package"):
            continue
        return line.lstrip("# ").strip() if line.startswith("#") else ""
    return ""


def tasks() -> dict[str, str]:
    """The tasks: files in ``envs/tasks``, whose names ``env.task`` takes, with their first line."""
    bases = ("__init__", "base", "experts", "manipulation", "torch_task")
    files = sorted(file for file in (PACKAGE / "envs" / "tasks").glob("*.py") if file.stem not in bases)
    return {file.stem: _first_line(file.read_text(encoding="utf-8")) for file in files}


def _first_line(source: str) -> str:
    return (ast.get_docstring(ast.parse(source)) or "").split("\n")[0]
