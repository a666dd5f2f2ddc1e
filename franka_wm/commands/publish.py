"""``franka-wm publish``: a dataset or a trained model to the Hugging Face Hub."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from franka_wm.commands.arguments import split
from franka_wm.data.lerobot.publish import publish_dataset
from franka_wm.errors import UserError
from franka_wm.training.publish import publish_model

OPTIONS: dict[str, Any] = {
    "root": "",
    "checkpoint": "",
    "repo_id": "",
    "private": True,
    "license": "apache-2.0",
    "update": False,
    "dry_run": False,
}

USAGE = """usage: franka-wm publish root=DATASET repo_id=USER/NAME [key=value …]
       franka-wm publish checkpoint=RUN repo_id=USER/NAME [key=value …]

  root=DATASET         a LeRobot dataset on disk
  checkpoint=RUN       a run's folder, or a checkpoint in it: weights, configuration and evaluation go, no replay
  repo_id=USER/NAME    where it goes
  private=true         who may see it; private=false: everybody
  license=apache-2.0   as the Hub names licenses
  update=true          the repository exists already: replace what is in it
  dry_run=true         (or --dry-run) show what would go, send nothing

Needs a token that may write: hf auth login, or the variable HF_TOKEN."""


def publish(arguments: Sequence[str]) -> int:
    """The verb."""
    if not arguments or arguments[0] in ("--help", "-h"):
        print(USAGE)
        return 0
    options, _ = split("publish", arguments, OPTIONS)
    if bool(options["root"]) == bool(options["checkpoint"]):
        raise UserError("publish: give root=DATASET or checkpoint=RUN, one of them")
    if not options["repo_id"]:
        raise UserError("publish: give repo_id=USER/NAME")
    shared = {key: options[key] for key in ("private", "license", "update", "dry_run")}
    if options["root"]:
        publish_dataset(options["root"], options["repo_id"], **shared)
    else:
        publish_model(options["checkpoint"], options["repo_id"], **shared)
    return 0
