"""A Python process that has imported what command lines need, and runs each of them in a fork of itself.

For what the tests' own process cannot be forked for: another interpreter, an environment that libraries read when they
are imported. Each command in a process of its own would import all of it again, which takes most of its CPU time.
"""

from __future__ import annotations

import functools
import importlib
import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

from forks import module, run_in_fork


class Preloaded:
    """That process. Close it.

    Args:
        modules: What it imports first.
        environment: All of its environment variables.
        python: The interpreter.
    """

    def __init__(self, *modules: str, environment: Mapping[str, str], python: str | Path = sys.executable):
        self._process = subprocess.Popen(
            [python, __file__, *modules],
            env=dict(environment), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd="/",
        )  # fmt: skip

    def run(
        self, module: str, *arguments: str, cwd: Path, **variables: str
    ) -> subprocess.CompletedProcess[str]:
        """``python -m MODULE ARGUMENT …`` there, with more environment variables."""
        assert self._process.stdin is not None and self._process.stdout is not None
        print(json.dumps([module, arguments, str(cwd), variables]), file=self._process.stdin, flush=True)
        return subprocess.CompletedProcess([module, *arguments], *json.loads(self._process.stdout.readline()))

    def close(self) -> None:
        """Ends it."""
        self._process.communicate()


def _work(name: str, arguments: list[str], variables: dict[str, str]) -> None:
    os.environ.update(variables)
    module(name, *arguments)()


def _main(modules: list[str]) -> None:
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what an import prints is no answer
    for name in modules:
        importlib.import_module(name)
    for line in sys.stdin:
        name, arguments, cwd, variables = json.loads(line)
        done = run_in_fork(functools.partial(_work, name, arguments, variables), Path(cwd))
        print(json.dumps([done.returncode, done.stdout, done.stderr]), file=answers, flush=True)


if __name__ == "__main__":
    _main(sys.argv[1:])
