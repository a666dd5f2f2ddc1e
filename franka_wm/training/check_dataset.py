"""Whether a dataset and the arm fit: observations, actions and views must mean the same in both."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from franka_wm.console import say
from franka_wm.envs.task_options import typed
from franka_wm.errors import UserError
from franka_wm.training.settings import RunSettings
from franka_wm.training.spaces import Spaces

if TYPE_CHECKING:
    from franka_wm.data.lerobot.mapping import FeatureMap
    from franka_wm.data.lerobot.source import Source

    type Named = Sequence[tuple[str, Source]]  # each with the option that names it


def check_dataset(run: RunSettings) -> None:
    """Whether the run can learn from the dataset that it names, and act in its environment with what it learns.

    Raises:
        UserError: One line.
    """
    if run.is_discrete:
        raise UserError(
            f"dataset={run.dataset.kind}: model={run.model.name} learns from its own search, not from recordings"
        )
    if run.env.kind not in ("none", "franka"):
        raise UserError(
            f"dataset={run.dataset.kind}: env={run.env.kind} is not what the arm recorded; use env=none or that task"
        )
    root, repo_id = run.dataset.root, run.dataset.repo_id
    if (root is None) == (repo_id is None):
        raise UserError("dataset=lerobot: give dataset.root=FOLDER or dataset.repo_id=USER/NAME, one of them")
    arm = run.env.arm if run.is_arm else None
    if root is not None or arm is not None:  # without an arm nothing is compared: a dataset by name can wait
        from franka_wm.data.lerobot.opening import find_datasets, read_datasets

        found = find_datasets(root, repo_id, meta=True)
        sources, mappings = read_datasets(
            [folder for _, folder in found],
            features=run.dataset.features,
            image_size=run.dataset.image_size,
            normalize_actions=run.dataset.normalize_actions,
            **run.of_recorded,
        )
        if arm is not None:
            _check_same_observations(run, mappings[0])
            named = [(option, source) for (option, _), source in zip(found, sources, strict=True)]
            _check_same_actions(run, named)
            _check_same_views(run, named)


def _check_same_observations(run: RunSettings, recorded: FeatureMap) -> None:
    """What the model will read of the data, the arm that it is to act in must show."""
    family, wanted = run.model.family, run.model.observations
    if not (family.has_next or family.has_policy):
        return
    arm = Spaces.of_config(run.env.arm)
    there = {key: (size,) for key, (_, size) in recorded.vectors.items()}
    here = {key: (size,) for key, size in arm.observation_sizes.items()}
    if wanted is not None:  # else a model reads vectors alone
        there |= {key: size[:2] for key, (_, size) in recorded.images.items()}
        here |= {key: size[:2] for key, size in arm.image_sizes.items()}
    for key in there if wanted is None else [key for key in wanted if key in there]:
        if here.get(key) != there[key]:
            size = f"of size {' × '.join(map(str, there[key]))}"
            shown = "does not show it" if key not in here else f"has {' × '.join(map(str, here[key]))}"
            raise UserError(
                f"dataset: {key} is {size} there, env.task={run.env.arm.task} {shown}, so what is learned cannot act "
                "here; choose model.observations, dataset.features or dataset.image_size, or env=none to train alone"
            )


def _check_same_actions(run: RunSettings, sources: Named) -> None:
    """Actions must mean the same, of the same robot; rewards of another task and other physics are said."""
    from franka_wm.data.lerobot.provenance import ACTIONS, other_option, recorded_sessions, told

    env = {**vars(run.env.arm), "urdf_path": run.env.urdf_path}
    for option, source in sources:
        sessions = recorded_sessions(source.root)
        if (changed := other_option(sessions, env, ACTIONS)) is not None:
            name, there = changed
            raise UserError(
                f"{option}: recorded with env.{name}={there}, this run has {typed(env[name])}, so actions "
                f"mean something else; use env.{name}={there}, or env=none to train alone"
            )
        for line in told(sessions, env):
            say(f"{option}: {line}")


def _check_same_views(run: RunSettings, sources: Named) -> None:
    """What a model that acts has learned to see, its world must show; sizes are compared elsewhere."""
    from franka_wm.data.lerobot.provenance import VIEWS, other_option, other_scene, recorded_sessions, told

    arm, family = run.env.arm, run.model.family
    env = {**vars(arm), "urdf_path": run.env.urdf_path}
    looks = {*(run.model.observations or ())} & {*Spaces.of_config(arm).image_sizes}
    if not (family.has_next or family.has_policy):
        return
    chosen = ("image_size", *(("cameras",) if run.dataset.features else ()))  # for the dataset
    views = [name for name in VIEWS if looks and name not in chosen]
    for option, source in sources:
        sessions = recorded_sessions(source.root)
        if changed := other_option(sessions, env, views):
            name, there = changed
            raise UserError(
                f"{option}: recorded with env.{name}={there}, this run has {typed(env[name])}, so "
                f"images show something else; use env.{name}={there}, or env=none to train alone"
            )
        if other_scene(sessions, env, images=bool(looks)):
            other = f"{option}: recorded with another env.scene, so {'images' if looks else 'states'} show something"
            raise UserError(f"{other} else; give the same, or env=none to train alone")
        for line in told(sessions, env, looks=True) if looks else ():
            say(f"{option}: {line}")
