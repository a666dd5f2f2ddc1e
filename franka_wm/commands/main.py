"""``franka-wm VERB``: what is there, and what can be done with it.

A verb is one line in :data:`VERBS`. Its function is imported when it is called and gets the arguments after
the verb; it returns an exit status, or nothing for 0.

Nothing here imports the simulator or torch: ``list`` reads files.
"""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path

from franka_wm.commands.arguments import CHECKOUT, did_you_mean
from franka_wm.errors import FrankaError, UserError
from franka_wm.version import __version__

# verb -> (module:function, arguments, what it does in one line)
VERBS: dict[str, tuple[str, str, str]] = {
    "list": (
        "franka_wm.commands.main:show_list",
        "",
        "environments, robots, tasks, models, planners and experiments",
    ),
    "train": (
        "franka_wm.commands.train:command",
        "[key=value …]",
        "train an agent; the same as python train.py",
    ),
    "evaluate": (
        "franka_wm.commands.evaluate:main",
        "checkpoint=… [key=value …]",
        "judge a checkpoint on held-out episodes: success, predictions, latents, robustness",
    ),
    "summary": ("franka_wm.commands.summary:summary", "RUN … | SWEEP", "runs of several seeds in one table"),
    "report": (
        "franka_wm.commands.report:report",
        "RUN [out=…]",
        "a run's page: report.html, one self-contained file",
    ),
    "compare": (
        "franka_wm.commands.compare:compare",
        "RUN RUN … [out=…]",
        "several runs side by side on one page",
    ),
    "view": (
        "franka_wm.commands.view:view",
        "[checkpoint=RUN]",
        "an arm in the browser: drag its goal; view --help",
    ),
    "demo": ("franka_wm.commands.demo:demo", "", "the same page with a small trained agent, at once"),
    "collect": (
        "franka_wm.commands.collect:collect",
        "out=FOLDER …",
        "gather a LeRobot dataset with any policy",
    ),
    "export": (
        "franka_wm.commands.export:export",
        "source=RUN out=…",
        "a run's replay as a LeRobot dataset",
    ),
    "publish": (
        "franka_wm.commands.publish:publish",
        "root=… repo_id=…",
        "a dataset or a model to the Hub",
    ),
    "bench": ("franka_wm.commands.main:bench", "NAME [options]", "run a benchmark of this checkout"),
}

# The values of FrankaConfig.robot, which lives in a package that imports the simulator.
ROBOTS = {
    "embedded": "FR3 drawn with primitives; ships with the package",
    "newton_asset": "FR3 with meshes, downloaded by Newton; needs the extra [meshes]",
    "panda_meshes": "Panda with thinned-out meshes; needs the extra [meshes]",
    "panda_meshes_full": "the same with every triangle, for close-ups",
    "urdf": "a URDF of your own: urdf_path=…",
}

PACKAGE = Path(__file__).parents[1]

USAGE, INTERRUPTED = 2, 130


def main(arguments: list[str] | None = None) -> int:
    """Runs one verb.

    Args:
        arguments: Without the program's name; the command line's if not given.

    Returns:
        Exit status: 0, 1 for bad input inside a verb, 2 for a verb that does not exist, 130 after Ctrl-C.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        status = run(*arguments)
        sys.stdout.flush()  # here, where a closed pipe is caught, and not at exit
        return status
    except FrankaError as error:
        complain(str(error))
        return 1
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:  # … | head
        # What Python would still flush at exit goes nowhere instead of into a traceback.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1


def run(verb: str = "--help", *arguments: str) -> int:
    """One verb's exit status."""
    if verb in ("--help", "-h", "help"):
        print(usage())
        return 0
    if verb == "--version":
        print(f"franka-wm {__version__}")
        return 0
    if verb not in VERBS:
        complain(
            f"no verb {verb!r}; choose from {', '.join(VERBS)}, or --help{did_you_mean(verb, list(VERBS))}"
        )
        return USAGE
    module, function = VERBS[verb][0].split(":")
    return getattr(import_module(module), function)(list(arguments)) or 0


def usage() -> str:
    rows = [(f"{verb} {arguments}".strip(), line) for verb, (_, arguments, line) in VERBS.items()]
    rows += [("--version", "print the version"), ("--help", "print this")]
    lines = "\n".join(f"  franka-wm {left:22s} {line}" for left, line in rows)
    return f"usage: franka-wm VERB …\n\n{lines}"


def complain(message: str) -> None:
    print(f"error: {message}", file=sys.stderr, flush=True)


# -- list ---------------------------------------------------------------------------------------------------


def show_list(arguments: list[str]) -> None:
    """Prints one line for each thing that can be named in a configuration."""
    if arguments and arguments[0] not in ("--help", "-h"):
        raise UserError(f"list takes no arguments, got {arguments[0]!r}")
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
    bases = ("__init__", "base", "torch_task")
    files = sorted(file for file in (PACKAGE / "envs" / "tasks").glob("*.py") if file.stem not in bases)
    return {file.stem: _first_line(file.read_text(encoding="utf-8")) for file in files}


def _first_line(source: str) -> str:
    return (ast.get_docstring(ast.parse(source)) or "").split("\n")[0]


# -- bench --------------------------------------------------------------------------------------------------


def bench(arguments: list[str]) -> int:
    """Runs ``benchmarks/NAME.py`` of the checkout in a Python of its own, with the arguments after the name."""
    folder = CHECKOUT / "benchmarks"
    names = sorted(file.stem for file in folder.glob("*.py") if file.stem != "common" and file.stem[0] != "_")
    if not names or not (CHECKOUT / "pyproject.toml").is_file():  # site-packages may have a "benchmarks", too
        raise UserError(
            "bench: the benchmarks are in a checkout of the repository, which this installation is not"
        )
    if not arguments or arguments[0] in ("--help", "-h"):
        print(f"usage: franka-wm bench {{{','.join(names)}}} [options]; each has --help")
        return 0 if arguments else USAGE
    name, *rest = arguments
    if name not in names:
        raise UserError(f"bench: no benchmark {name!r}; choose from {', '.join(names)}")
    return subprocess.run([sys.executable, str(folder / f"{name}.py"), *rest], check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
