"""``franka-wm export``: the replay of a run becomes a dataset."""

from __future__ import annotations

import click

from franka_wm.commands.arguments import check_run, plugins, verb, whole, word
from franka_wm.console import announced
from franka_wm.data.lerobot.schema import FORMATS
from franka_wm.errors import UserError


@verb("export")
@word("source", "a run's folder, or a checkpoint in it", metavar="RUN", required=True)
@word("out", "where the dataset goes; it appears whole, at the end", metavar="FOLDER", required=True)
@word(
    "format",
    "how images are stored: bit for bit, small, or small and nearly exact",
    click.Choice([*FORMATS]),
    "exact",
)
@word("workers", "writing processes", whole(0, 256), 2)
@plugins
def export(source: str, out: str, format: str, workers: int) -> None:
    """Write a run's replay as a LeRobot dataset.

    The checkpoint must have been saved with its replay (trainer.checkpoint_replay=true). Only whole episodes are
    written; how many partial ones the buffer holds is said.
    """
    check_run("export", "source", source)
    from franka_wm.data.lerobot.writer import check_out

    check_out(out, resumable=False)
    from franka_wm.data.lerobot.export import arm_config, export_replay, tell
    from franka_wm.training.checkpoint import latest_checkpoint, load_checkpoint
    from franka_wm.training.load import require_same_actions
    from franka_wm.training.resume import gathered_with

    checkpoint = load_checkpoint(latest_checkpoint(source))
    resolved = checkpoint.config
    config = arm_config(resolved)
    data = checkpoint.replay()
    if data is None:
        raise UserError(
            f"export: {checkpoint.folder} was saved without its replay; train with trainer.checkpoint_replay=true"
        )
    if others := gathered_with(checkpoint):
        raise UserError(
            f"export: {checkpoint.folder}: its run went on from experience gathered with {', '.join(others)}, and a "
            "dataset is of one environment; export a run that stayed in one"
        )
    if not data.get("action").is_floating_point():
        require_same_actions(checkpoint, config)
    with announced(f"writing {data.numel()} steps"):
        done = export_replay(
            data,
            config=config,
            out=out,
            seed=int(resolved["seed"]),
            policy=f"training run {source}",
            settings=resolved,
            format=format,
            workers=workers,
        )
    tell(done)
