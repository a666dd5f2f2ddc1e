"""LeRobot's programs in forks of a process that has loaded LeRobot: ``python lerobot_tools.py``.

Each line that it reads is a folder and a command as JSON; it answers with the exit status and the output.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

BIN = Path(sys.executable).parent


class Tools:
    """That process; `environment` is its own, which LeRobot reads where it is loaded."""

    def __init__(self, environment: dict[str, str]) -> None:
        self._process = subprocess.Popen(
            [sys.executable, __file__],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def __call__(self, cwd: Path, name: str, *options: str) -> str:
        """Run a program in a folder; what it said. It must end well."""
        assert self._process.stdin is not None and self._process.stdout is not None
        print(json.dumps([str(cwd), name, *options]), file=self._process.stdin, flush=True)
        status, said = json.loads(self._process.stdout.readline())
        assert status == 0, said[-3000:]
        return said

    def close(self) -> None:
        """End it."""
        self._process.communicate(timeout=60)


def _main() -> None:
    import lerobot.scripts.lerobot_edit_dataset
    import lerobot.scripts.lerobot_eval
    import lerobot.scripts.lerobot_train  # noqa: F401

    from forks import run_in_fork, script

    for line in sys.stdin:
        cwd, name, *options = json.loads(line)
        done = run_in_fork(script(BIN / name, *options), Path(cwd), seconds=600)
        print(json.dumps([done.returncode, done.stdout + done.stderr]), flush=True)


if __name__ == "__main__":
    _main()
