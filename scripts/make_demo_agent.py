"""Train the small agent of ``franka-wm demo`` and put it into the package: ``make demo-agent``.

About ten minutes on two CPU cores. ``--run RUN`` takes a run that exists already. Weights, configuration and sizes
are kept; optimiser, replay, random states and evaluation are not. To be repeated when a change of the model's code
makes the weights unreadable, which a test notices.
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from franka_wm.commands.demo import AGENT
from franka_wm.training.publish import stage_model

ROOT = Path(__file__).resolve().parents[1]
OVERRIDES = (
    "env=reach",
    "scale=laptop",
    "model.latent_dim=64",
    "model.encoder_dim=128",
    "model.hidden_dim=128",
    "trainer.updates=4000",
    "evaluation.video_episodes=0",
)
LARGEST = 3 * 2**20
"""Of the whole folder [bytes]: it travels with every wheel."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--run", type=Path, help="a run's folder; trains one if not given")
    run = parser.parse_args().run
    with tempfile.TemporaryDirectory() as place:
        if run is None:
            run = Path(place) / "run"
            command = [sys.executable, str(ROOT / "train.py"), *OVERRIDES, f"hydra.run.dir={run}"]
            subprocess.run(command, cwd=ROOT, check=True)
        staged = Path(place) / "agent"
        staged.mkdir()
        stage_model(run, staged, repo_id="franka-wm/demo", license="apache-2.0")
        for name in ("README.md", "evaluation.json", "evaluation.md"):
            (staged / name).unlink(missing_ok=True)
        size = sum(file.stat().st_size for file in staged.iterdir())
        if size > LARGEST:
            sys.exit(f"the agent has {size:,} bytes, above {LARGEST:,}: make its model smaller")
        shutil.rmtree(AGENT, ignore_errors=True)
        shutil.copytree(staged, AGENT)
    print(f"{AGENT}: {size:,} bytes")


if __name__ == "__main__":
    main()
