"""Commands in forks of a process that has loaded neither torch nor the simulator: what they print and import."""

from __future__ import annotations

import json
import runpy
import subprocess
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

HELPERS = Path(__file__).resolve().parent


@dataclass(frozen=True)
class Answer:
    """How a command ended.

    Attributes:
        returncode: The exit status.
        stdout, stderr: What it printed.
        loaded: The modules at the top that it, or the process before it, has imported.
    """

    returncode: int
    stdout: str
    stderr: str
    loaded: frozenset[str]


def answers(commands: Iterable[tuple[str, ...]], cwd: Path) -> dict[tuple[str, ...], Answer]:
    """Run command lines one after another, each in a fork.

    Args:
        commands: The program, a file or ``-m MODULE`` as for Python, and its arguments.
        cwd: The working directory of all.
    """
    given = list(dict.fromkeys(commands))
    done = subprocess.run(
        [sys.executable, str(HELPERS / "light.py"), str(cwd)],
        input=json.dumps(given),
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    found = [Answer(*one[:3], frozenset(one[3])) for one in json.loads(done.stdout)]
    return dict(zip(given, found, strict=True))


def _work(arguments: list[str], modules: Path) -> Callable[[], Any]:
    def work() -> None:
        try:
            if arguments[0] == "-m":
                sys.argv = arguments[1:]
                runpy.run_module(arguments[1], run_name="__main__", alter_sys=True)
            else:
                sys.argv = list(arguments)
                runpy.run_path(arguments[0], run_name="__main__")
        finally:
            modules.write_text(json.dumps(sorted({name.partition(".")[0] for name in sys.modules})))

    return work


def _main(cwd: Path) -> None:
    import tempfile

    import franka_wm.commands.entry
    import franka_wm.commands.main  # noqa: F401
    from configuration import compose_once
    from forks import run_in_fork

    compose_once()
    results = []
    with tempfile.TemporaryDirectory() as folder:
        modules = Path(folder, "modules")
        for arguments in json.load(sys.stdin):
            done = run_in_fork(_work(arguments, modules), cwd, seconds=60)
            results.append([done.returncode, done.stdout, done.stderr, json.loads(modules.read_text())])
    print(json.dumps(results))


if __name__ == "__main__":
    _main(Path(sys.argv[1]))
