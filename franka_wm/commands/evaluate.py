"""``franka-wm evaluate``: everything that can be said about a checkpoint, measured from the checkpoint alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from franka_wm.commands.arguments import FLAG, TYPED, check_run, plugins, verb, whole, word
from franka_wm.console import say
from franka_wm.errors import UserError
from franka_wm.files import run_of, unwritable
from franka_wm.interrupt import INTERRUPTED


@verb(
    "evaluate",
    first="checkpoint",
    others=("planner=", "planner.", "objective.", "hydra.searchpath="),
    shown=(
        "planner.KEY=…",
        "plans otherwise than the run did, also planner=NAME, objective.KEY=…; wants out=FOLDER. One of "
        "your own: plugins= and hydra.searchpath=[file://FOLDER], as for train",
    ),
)
@word(
    "checkpoint",
    "a run's folder, a checkpoint in it, or hf:user/name; the bare folder will do",
    metavar="FOLDER",
    required=True,
)
@word("out", "where results go (RUN/evaluation; for hf: outputs/evaluation/user--name)", metavar="FOLDER")
@word(
    "episodes",
    "per policy, on fixed held-out seeds; the run's evaluation.episodes",
    whole(2, 10**6),
    metavar="N",
)
@word("device", "auto, cpu, cuda, cuda:K", default="auto")
@word(
    "open_loop",
    "latent error by horizon, rank correlation, value calibration, imagined beside real",
    FLAG,
    True,
)
@word("probes", "joints, tool and goal predicted from the latents by probes; spectrum", FLAG, True)
@word("robustness", "the same in shifted worlds: looks, camera, dynamics, delay, noise", FLAG, False)
@plugins
def evaluate(checkpoint: str, out: str | None, overrides: Sequence[str] = (), **options: Any) -> int:
    """Evaluate a checkpoint on held-out episodes. Success, predictions, latents, robustness.

    Writes evaluation.json and evaluation.md (the same twice on a CPU), timing.json, imagined.png, imagined.mp4.
    """
    own = default_folder(checkpoint)
    planned_with = ", ".join(one for one in overrides if not one.startswith("hydra.searchpath="))
    if planned_with and (out is None or Path(out).resolve() in (own.resolve(), own.parent.resolve())):
        raise UserError(
            f"evaluate: {planned_with}: results of other settings than the run's do not take the place of its own; "
            "give another folder, out=FOLDER"
        )
    place = own if out is None else Path(out)
    check_folder(place)
    check_run("evaluate", "checkpoint", checkpoint)
    check_other(place, own, planned_with)
    check_larger(place, options["episodes"], checkpoint)
    from franka_wm.commands.evaluate_checkpoint import Options, run

    context = click.get_current_context(silent=True)
    typed = () if context is None else tuple(context.meta[TYPED])
    words = {"overrides": tuple(overrides), "planned_with": planned_with, "typed": typed}
    before = _written(place)
    try:
        run(Options(checkpoint=checkpoint, out=place, **words, **options))
    except KeyboardInterrupt:
        say(f"stopped; {_told(place, before)}")
        return INTERRUPTED
    return 0


def _written(folder: Path) -> int | None:
    """When the result there was written [ns]; ``None`` where there is none."""
    file = folder / "evaluation.json"
    return file.stat().st_mtime_ns if file.is_file() else None


def _told(folder: Path, before: int | None) -> str:
    """What an evaluation that was stopped has written.

    Args:
        folder: Where its results go.
        before: What :func:`_written` said when it began.
    """
    now = _written(folder)
    if now is not None and now != before:
        return (
            f"{folder} has the results of all episodes, not those of the diagnostics; evaluate again for them"
        )
    return (
        f"nothing was written{f'; the result that was in {folder} is still there' if now is not None else ''}"
    )


def default_folder(checkpoint: str) -> Path:
    """Where results go if not said: beside the run's own, or under ``outputs`` for one from the Hub."""
    if checkpoint.startswith("hf:"):
        return Path("outputs") / "evaluation" / checkpoint.removeprefix("hf:").replace("/", "--")
    return run_of(Path(checkpoint)) / "evaluation"


def check_folder(folder: Path) -> None:
    """Whether results can go there; asked before anything is played.

    Raises:
        UserError: It or what it lies in is a file, or may not be written to.
    """
    why = unwritable(folder)
    if why is not None:
        raise UserError(f"evaluate: out={folder}: {why}; give another folder for the results")


def check_other(folder: Path, own: Path, planned_with: str) -> None:
    """Whether a result of something else would be lost there: of another run, or planned otherwise.

    Raises:
        UserError: It would.
    """
    if (folder / "checkpoints").is_dir() and folder.resolve() != own.parent.resolve():
        raise UserError(
            f"evaluate: out={folder}: is the folder of another run, whose results would be lost; give another folder"
        )
    if not (folder / "evaluation.json").is_file():
        return
    from franka_wm.evaluation.results import read_result

    try:
        there = read_result(folder / "evaluation.json").protocol.get("planned with", "")
    except UserError:  # nobody can read it
        return
    if there != planned_with:
        how = f"planned with {there}" if there else "planned as its run did"
        raise UserError(
            f"evaluate: {folder} holds a result {how}, which this one would replace; give another out="
        )


def check_larger(folder: Path, episodes: int | None, checkpoint: str) -> None:
    """Whether a result of more episodes would be lost there; asked before anything is played.

    A result of earlier weights may go: it would not be shown any more.

    Args:
        folder: Where results go.
        episodes: How many will be played; ``None``: as many as the run's own.
        checkpoint: As it was given.

    Raises:
        UserError: It would be lost, or there is no checkpoint to compare it with.
    """
    if not (folder / "evaluation.json").is_file():
        return
    from franka_wm.evaluation.results import read_result

    try:
        there = read_result(folder / "evaluation.json")
    except UserError:  # nobody can read it
        return
    if episodes is not None and there.episodes <= episodes:
        return
    from franka_wm.training.load import find_checkpoint, own_episodes

    found = find_checkpoint(checkpoint)
    episodes = own_episodes(found) if episodes is None else episodes
    earlier = there.updates is not None and there.updates < found.counters.get("updates", 0)  # weights
    if there.episodes <= episodes or earlier:
        return
    raise UserError(
        f"evaluate: {folder} holds a result of {there.episodes} episodes, which one of {episodes} would replace; "
        "give out=FOLDER, or more episodes="
    )
