"""The rooms of docs/architecture.md: imports point down only, no files import one another in a circle, none is long."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[1]
LONGEST = 450  # lines of a file
LONGEST_TASK = 150  # of a task with a gripper
PAGE = ROOT / "docs" / "architecture.md"
FILES = {
    ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): file
    for file in [ROOT / "train.py", *(ROOT / "franka_wm").rglob("*.py")]
}


def rooms() -> dict[str, set[str]]:
    """Room → the rooms that it may import besides itself and the ground, from the page's table."""
    table = PAGE.read_text(encoding="utf-8").split("## Rooms\n")[1].split("\n## ")[0]
    rows = [line.split("|") for line in table.splitlines() if line.startswith("| `")]
    rights = {row[1].strip(" `"): row[3] for row in rows}
    return {
        room: set(rights) - {"train"} if "everything" in right else set(re.findall(r"`(\w+)`", right))
        for room, right in rights.items()
    }


def room_of(module: str) -> str:
    """The folder below ``franka_wm``; ``ground`` for a file beside the folders; ``train`` for what users start from."""
    if module in ("train", "franka_wm", "franka_wm.__main__"):
        return "train"
    return module.split(".")[1] if (ROOT / "franka_wm" / module.split(".")[1]).is_dir() else "ground"


def imports(module: str, *, types: bool) -> set[str]:
    """Our modules that a file names: imports wherever they stand, and modules as text, as registries have them.

    Args:
        types: Also imports below ``if TYPE_CHECKING``, which never run.
    """
    found: set[str] = set()
    todo: list[ast.AST] = [ast.parse(FILES[module].read_text(encoding="utf-8"))]
    while todo:
        node = todo.pop()
        if not types and isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            todo += node.orelse
            continue
        todo += ast.iter_child_nodes(node)
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: a relative import; write the whole name"
            whole = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= {name if name in FILES else str(node.module) for name in whole}
        elif isinstance(node, ast.Constant) and str(node.value).startswith("franka_wm."):
            found.add(str(node.value).split(":")[0])
    return {name for name in found if name in FILES and name not in (module, "franka_wm")}


def test_every_folder_is_a_room_of_the_page() -> None:
    folders = {file.parent.name for file in (ROOT / "franka_wm").glob("*/__init__.py")}
    assert folders | {"ground", "train"} == set(rooms())


def test_imports_follow_the_page() -> None:
    allowed = rooms()
    wrong = [
        f"{module} ({room_of(module)}) imports {name} ({room_of(name)})"
        for module in FILES
        for name in sorted(imports(module, types=True))
        if room_of(name) not in {room_of(module), "ground", *allowed[room_of(module)]}
    ]
    assert not wrong, "\n".join(wrong)


def test_no_circle_of_files() -> None:
    try:
        TopologicalSorter({module: imports(module, types=False) for module in FILES}).prepare()
    except CycleError as error:
        raise AssertionError(" → ".join(reversed(error.args[1]))) from None


def test_no_file_is_long() -> None:
    """A file has one concern: split it by that, not by its length."""
    folders = ("franka_wm", "tests", "benchmarks", "scripts", "examples")
    files = [ROOT / "train.py", *(file for folder in folders for file in (ROOT / folder).rglob("*.py"))]
    lengths = {file: len(file.read_text(encoding="utf-8").splitlines()) for file in files}
    assert len(lengths) > 300
    assert not [f"{f.relative_to(ROOT)}: {n} lines" for f, n in lengths.items() if n > LONGEST]


def test_the_exit_status_after_ctrl_c_is_written_once() -> None:
    nodes = {module: ast.walk(ast.parse(file.read_text(encoding="utf-8"))) for module, file in FILES.items()}
    told = {
        name
        for name, some in nodes.items()
        for node in some
        if isinstance(node, ast.Constant) and node.value == 130
    }
    assert told == {"franka_wm.interrupt"}


def test_the_key_of_lost_contacts_is_written_once() -> None:
    """Elsewhere the word counts them: in statistics and what is printed of these."""
    keys = (
        "specs.py",
        "image_storage.py",
        "replay.py",
        "hindsight.py",
        "episodes.py",
        "recorder.py",
        "resume.py",
        "moment.py",
    )
    for module, file in FILES.items():
        if file.name in keys:
            texts = {
                n.value
                for n in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
                if isinstance(n, ast.Constant)
            }
            assert "overflow" not in texts, module


def test_what_writes_datasets_loads_nothing_heavy() -> None:
    """Each writing process would take seconds, and its memory, for it."""
    loads = "import sys, franka_wm.data.lerobot.shard_workers"
    said = f"{loads}; sys.exit(not {{'torch', 'scipy'}}.isdisjoint(sys.modules))"
    assert subprocess.run([sys.executable, "-c", said], check=False).returncode == 0


def test_a_task_with_a_gripper_is_one_short_file() -> None:
    texts = {f.name: f.read_text(encoding="utf-8") for f in (ROOT / "franka_wm/envs/tasks").glob("*.py")}
    tasks = {name: text.splitlines() for name, text in texts.items() if "(GripperTask):" in text}
    assert {"lift.py", "push.py", "pick.py", "stack.py", "drawer.py", "peg.py"} <= set(tasks)
    assert not [f"{name}: {len(lines)} lines" for name, lines in tasks.items() if len(lines) > LONGEST_TASK]
