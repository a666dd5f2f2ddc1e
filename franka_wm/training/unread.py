"""Images that nothing reads, randomization that none shows, goals that the model cannot see: each said in one line."""

from __future__ import annotations

from collections.abc import Collection

from franka_wm.console import say
from franka_wm.envs.config import FrankaConfig
from franka_wm.envs.tasks import make_task
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
    if run.is_arm:
        _say_unshown(run.env.arm, spaces)


def say_unseen_goal(run: RunSettings) -> None:
    """Says so where each episode has another goal, rewards are for reaching it, and the model reads nothing of it."""
    if not run.is_arm or run.objective_name == "goal_image" or not run.model.family.has_value:
        return
    config, keys = run.env.arm, run.model.observations
    read = config.observations if keys is None else keys
    drawn = config.show_goal and any("pixels" in key for key in read)
    seen = drawn or any(key in ("state", "goal") or "goal_pixels" in key for key in read)
    if not (seen or config.fixed_goal) and make_task(config).relabels():
        say(
            "warning: each episode has another goal, and the model reads nothing that shows it: add state or goal to "
            "model.observations, or set env.show_goal=true"
        )


def _say_unshown(config: FrankaConfig, spaces: Spaces) -> None:
    """Says which randomization no image shows."""
    colored = [key for key in spaces.image_sizes if "pixels" in key]  # neither depth nor segmentation
    cameras = {*config.cameras} & {"front", "side"} if spaces.image_sizes else set()
    shown: dict[str, Collection[str]] = {"color": colored, "brightness": colored}
    shown |= {"camera_position": cameras, "camera_target": cameras}  # the wrist's moves with the hand
    drawn = config.randomization
    for name, by in shown.items():
        if (value := getattr(drawn, name)) and not by:
            say(
                f"env.randomization.{name}={value:g}: does nothing, no image shows it (env.cameras, env.observations)"
            )


def _say_unseen(run: RunSettings, spaces: Spaces) -> None:
    """Says which images the model reads that its encoder, frozen by then, never learned from."""
    shown = run.first_stage().model.observations or ()
    unseen = [key for key in run.model.observations or () if key in spaces.image_sizes and key not in shown]
    if unseen:
        say(
            f"the first stage does not see {', '.join(unseen)}, which the model reads: "
            f"'pretrain.model.observations=[{','.join([*shown, *unseen])}]'"
        )
