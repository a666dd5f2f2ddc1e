"""``franka-wm export``: the replay of a run becomes a dataset."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from franka_wm.commands.arguments import required, split
from franka_wm.console import announced
from franka_wm.data.lerobot.export import arm_config, export_replay, tell
from franka_wm.data.lerobot.schema import FORMATS
from franka_wm.errors import UserError

OPTIONS: dict[str, Any] = {"source": "", "out": "", "format": "exact", "workers": 2}

USAGE = f"""usage: franka-wm export source=RUN out=FOLDER [key=value …]

  source=RUN        a run's folder, or a checkpoint in it, saved with its replay (trainer.checkpoint_replay=true)
  out=FOLDER        where the dataset goes; it appears whole, at the end
  format=exact      {"; ".join(f"{name}: {line}" for name, line in FORMATS.items())}
  workers=2         writing processes

Only whole episodes are written; how many partial ones the buffer holds is said."""


def export(arguments: Sequence[str]) -> int:
    """The verb."""
    from omegaconf import OmegaConf

    from franka_wm.training.checkpoint import latest_checkpoint, load_checkpoint

    if not arguments or arguments[0] in ("--help", "-h"):
        print(USAGE)
        return 0
    options, _ = split("export", arguments, OPTIONS)
    required("export", options, "source", "out")
    checkpoint = load_checkpoint(latest_checkpoint(options["source"]))
    data = checkpoint.replay()
    if data is None:
        raise UserError(
            f"export: {checkpoint.folder} was saved without its replay; train with trainer.checkpoint_replay=true"
        )
    resolved: Any = OmegaConf.to_container(checkpoint.config, resolve=True)
    with announced(f"writing {data.numel()} steps"):
        done = export_replay(
            data,
            config=arm_config(resolved),
            out=options["out"],
            seed=int(resolved["seed"]),
            policy=f"training run {options['source']}",
            settings=resolved,
            format=options["format"],
            workers=options["workers"],
        )
    tell(done)
    return 0
