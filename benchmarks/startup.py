"""How long until something happens: a command's first start on a machine, its second, and what is not training.

    python benchmarks/startup.py                          reach at scale=smoke, on this machine's device
    python benchmarks/startup.py --scale gpu env=lift     other arguments of train.py

Each start is a process of its own. The first one finds an empty folder for Warp's compiled kernels, the others what it
left there. Python keeps its bytecode, even where the environment forbids it: without, every start would compile torch.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from common import compose, publish

ROOT = Path(__file__).resolve().parents[1]
BUILT, UPDATED = "  done in ", "updates "
"""How lines begin that say: the worlds are built and have made a step; updates were made."""


def start(arguments: list[str], kernels: Path, out: Path) -> dict[str, float]:
    """Runs train.py; seconds from its start to each kind of line, by how they begin, and to its end as ``"end"``.

    Raises:
        SystemExit: It failed; with the end of what it said.
    """
    command = [sys.executable, str(ROOT / "train.py"), *arguments, f"hydra.run.dir={out}"]
    own = {"WARP_CACHE_PATH": str(kernels), "PYTHONUNBUFFERED": "1", "PYTHONDONTWRITEBYTECODE": ""}
    environment = {**os.environ, **own}
    begun, seen, said = time.perf_counter(), {}, []
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=ROOT, env=environment
    ) as run:
        assert run.stdout is not None
        for line in run.stdout:
            said.append(line)
            for beginning in (BUILT, UPDATED):
                if line.startswith(beginning):
                    seen.setdefault(beginning, time.perf_counter() - begun)
    if run.returncode:
        raise SystemExit("".join(said)[-4000:])
    return {**seen, "end": time.perf_counter() - begun}


def main() -> None:
    """Three runs, one after the other."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--scale", default="smoke", help="that of train.py")
    parser.add_argument("--out", help="JSON file for the rows")
    parser.add_argument("arguments", nargs="*", help="other arguments of train.py")
    args = parser.parse_args()
    command = [f"scale={args.scale}", *args.arguments]
    one_update = [*command, "trainer.updates=1", "evaluation.during=[]"]
    compose(*command)
    with tempfile.TemporaryDirectory() as folder:
        kernels, runs = Path(folder, "kernels"), Path(folder, "runs")
        first = start(one_update, kernels, runs / "first")
        second = start(one_update, kernels, runs / "second")
        whole = start(command, kernels, runs / "whole")
        training = json.loads((runs / "whole" / "evaluation.json").read_text())["protocol"][
            "training_seconds"
        ]
    rows: list[dict[str, str | float]] = [
        {"start": "first", "until": "first environment step", "seconds": first[BUILT]},
        {"start": "second", "until": "first environment step", "seconds": second[BUILT]},
        {"start": "second", "until": "first update", "seconds": second[UPDATED]},
        {"start": "second", "until": "the end, without training", "seconds": whole["end"] - training},
    ]
    for row in rows:
        row["seconds"] = round(float(str(row["seconds"])), 1)
    given = [word.removeprefix("device=") for word in args.arguments if word.startswith("device=")]
    publish("startup", rows, args.out, device=(given or ["auto"])[0], ran=("franka_wm/", "train.py"))


if __name__ == "__main__":
    main()
