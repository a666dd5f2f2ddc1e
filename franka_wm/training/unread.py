"""Images that are rendered and read by nothing, or seen by one stage of a run alone: each said in one line."""

from __future__ import annotations

from franka_wm.console import say
from franka_wm.planning.objectives import goal_images
from franka_wm.training.settings import RunSettings
from franka_wm.training.spaces import Spaces


def say_unread(run: RunSettings, spaces: Spaces) -> None:
    """Says which images are rendered and read by nothing that learns or plans."""
    read = {*(run.model.observations or ())}
    if run.pretrain.kind != "none":
        read |= {*(run.first_stage().model.observations or ())}
    if run.objective_name == "goal_image":
        read |= {*goal_images(read).values()}
    unread = [key for key in spaces.image_sizes if key not in read]
    if unread:
        say(f"not read by the model: {', '.join(unread)} (model.observations)")
    if run.pretrain.kind != "none":
        _say_unseen(run, spaces)


def _say_unseen(run: RunSettings, spaces: Spaces) -> None:
    """Says which images the model reads that its encoder, frozen by then, never learned from."""
    shown = run.first_stage().model.observations or ()
    unseen = [key for key in run.model.observations or () if key in spaces.image_sizes and key not in shown]
    if unseen:
        say(
            f"the first stage does not see {', '.join(unseen)}, which the model reads: "
            f"'pretrain.model.observations=[{','.join([*shown, *unseen])}]'"
        )
