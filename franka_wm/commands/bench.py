"""``franka-wm bench``: the benchmarks of a checkout."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from franka_wm.commands.arguments import verb
from franka_wm.errors import UserError
from franka_wm.options import did_you_mean

CHECKOUT = Path(__file__).parents[2]
"""Top of the repository, where ``benchmarks`` is, if the package runs from one."""


@verb("bench", raw="NAME [options]")
def bench(arguments: list[str]) -> int:
    """Run a benchmark of this checkout. It is benchmarks/NAME.py; each has options of its own and --help."""
    folder = CHECKOUT / "benchmarks"
    names = sorted(file.stem for file in folder.glob("*.py") if file.stem != "common" and file.stem[0] != "_")
    if not names or not (CHECKOUT / "pyproject.toml").is_file():  # site-packages may have a "benchmarks", too
        raise UserError("bench: benchmarks need a checkout of the repository; this is an installed package")
    if not arguments:
        raise UserError(f"bench: give NAME, one of {', '.join(names)}")
    name, *rest = arguments
    if name not in names:
        raise UserError(
            f"bench: no benchmark {name!r}; choose from {', '.join(names)}{did_you_mean(name, names)}"
        )
    return subprocess.run([sys.executable, str(folder / f"{name}.py"), *rest], check=False).returncode
