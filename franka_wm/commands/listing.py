"""``franka-wm list``: what can be named in a configuration. It reads files, and imports neither simulator nor torch."""

from __future__ import annotations

import ast
from pathlib import Path

from franka_wm.commands.arguments import verb

# The values of FrankaConfig.robot, which lives in a package that imports the simulator.
ROBOTS = {
    "embedded": "FR3 drawn with primitives; ships with the package",
    "newton_asset": "FR3 with meshes, downloaded by Newton; needs the extra [meshes]",
    "panda_meshes": "Panda with thinned-out meshes; needs the extra [meshes]",
    "panda_meshes_full": "the same with every triangle, for close-ups",
    "urdf": "a URDF of your own: urdf_path=…",
}

PACKAGE = Path(__file__).parents[1]


@verb("list")
def show_list() -> None:
    """List what can be chosen. Environments, models, planners, experiments and more, each with a line."""
    sections = {
        "environments (env=)": options("env"),
        "robots (env.robot=)": ROBOTS | options("env/robot"),
        "tasks (env.task=)": tasks(),
        "models (model=)": options("model"),
        "planners (planner=)": options("planner"),
        "experiments (experiment=)": options("experiment"),
    }
    for title, entries in sections.items():
        print(title)
        for name, line in entries.items():
            print(f"  {name:24s} {line}".rstrip())


def options(group: str) -> dict[str, str]:
    """The options of a configuration group: file name → its first comment line."""
    return {file.stem: _first_comment(file) for file in sorted((PACKAGE / "conf" / group).glob("*.yaml"))}


def _first_comment(file: Path) -> str:
    for line in file.read_text(encoding="utf-8").splitlines():
        if line.startswith("# @package"):
            continue
        return line.lstrip("# ").strip() if line.startswith("#") else ""
    return ""


def tasks() -> dict[str, str]:
    """The tasks: files in ``envs/tasks``, whose names ``env.task`` takes, with their first line."""
    bases = ("__init__", "base", "manipulation", "torch_task")
    files = sorted(file for file in (PACKAGE / "envs" / "tasks").glob("*.py") if file.stem not in bases)
    return {file.stem: _first_line(file.read_text(encoding="utf-8")) for file in files}


def _first_line(source: str) -> str:
    return (ast.get_docstring(ast.parse(source)) or "").split("\n")[0]
