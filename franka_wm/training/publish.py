"""Trained models to the Hugging Face Hub, privately unless told otherwise."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from omegaconf import OmegaConf

from franka_wm import models
from franka_wm.console import say
from franka_wm.data.lerobot.card import FILM, model_card
from franka_wm.data.lerobot.hub import check_license, check_repo_id
from franka_wm.data.lerobot.paths import shortened, without_paths
from franka_wm.data.lerobot.publish import README, publish_staged
from franka_wm.errors import UserError
from franka_wm.files import run_of
from franka_wm.training.checkpoint import latest_checkpoint, load_checkpoint
from franka_wm.training.manifest import read_manifest, saved_at, write_manifest
from franka_wm.training.tree import damaged, write_tree
from franka_wm.untrusted import UntrustedFolder, values_of


def publish_model(
    checkpoint: str | Path,
    repo_id: str,
    *,
    private: bool = True,
    license: str = "apache-2.0",
    update: bool = False,
    dry_run: bool = False,
) -> None:
    """Sends a trained model: what ``load_agent("hf:user/name")`` needs, the evaluation, and a card.

    Args:
        checkpoint: A run's folder, or a checkpoint in it.
        repo_id, private, license, update, dry_run: As for :func:`publish_dataset`.

    Raises:
        UserError: One line.
    """
    check_repo_id(repo_id)
    check_license(license)
    latest_checkpoint(Path(checkpoint))  # refused before the Hub's token is asked for

    def stage(place: Path) -> Path:
        return stage_model(Path(checkpoint), place, repo_id=repo_id, license=license)

    publish_staged(stage, repo_id, "model", private=private, update=update, dry_run=dry_run)


def stage_model(checkpoint: Path, place: Path, *, repo_id: str, license: str) -> Path:
    """A checkpoint without what only training needs: no optimiser, replay, worlds, random states or absolute paths.

    Args:
        checkpoint: A run's folder, or a checkpoint in it.
        place: An empty folder.
        repo_id, license: For the card.

    Returns:
        ``place``, which is a checkpoint now.
    """
    folder = latest_checkpoint(checkpoint)
    run = run_of(folder)
    files = UntrustedFolder(run)
    files.below(folder.relative_to(run)).check_links()
    opened = load_checkpoint(folder)
    manifest = read_manifest(opened.folder)
    for name in ("model.safetensors", "counters.json"):
        if name in manifest.files:
            shutil.copyfile(opened.folder / name, place / name)
    config = without_paths(opened.config, clear=True)
    if "resume" in config:
        config["resume"] = None
    OmegaConf.save(OmegaConf.create(config), place / "config.yaml")
    with damaged(opened.folder, "extra.json"):
        sizes = {key: value for key, value in (opened.extra() or {}).items() if key == "spaces"}
    write_tree(place, "extra", sizes)  # curves, worlds and their images stay here
    write_manifest(place, manifest.model, written_by=manifest.written_by, saved_at_ns=saved_at(opened.folder))
    # Where the verb evaluate puts them, unless it played fewer episodes; a published model has them at its top.
    updates = opened.counters.get("updates")
    places = ("evaluation/", "") if files.path("evaluation/evaluation.md") else ("",)
    measured = {where: _episodes(files, where, updates) for where in places}
    usable = {where: worth for where, worth in measured.items() if worth is not None}
    written = max(usable, key=lambda where: usable[where], default="")
    if written in usable:
        if source := files.path(f"{written}evaluation.json"):
            _copy_json(source, place / "evaluation.json")
        if (text := files.text(f"{written}evaluation.md")) is not None:
            (place / "evaluation.md").write_text(shortened(text), encoding="utf-8")
    if None in measured.values() and not (place / "evaluation.json").is_file():
        say(f"no evaluation goes along: that of {run} is of other weights; franka-wm evaluate {folder} first")
    acting = _acting(config["model"]["name"])  # a film of an encoder's run shows a policy without it
    if (film := files.path(FILM)) and measured[""] is not None and acting is not None:
        shutil.copyfile(film, place / FILM)
    card = model_card(place, repo_id=repo_id, license=license, acting=acting)
    (place / README).write_text(card, encoding="utf-8")
    return place


def _acting(model: str) -> str | None:
    """The policy that a family is about; ``None`` for an encoder. One of one's own, which is not here, plans."""
    if model not in models.available():
        return "planner"
    family = models.family(model)
    able = {"planner": family.has_next, "policy": family.has_policy}
    return next((name for name, has in able.items() if has), None)


def _episodes(files: UntrustedFolder, place: str, updates: float | None) -> tuple[bool, int] | None:
    """Whether an ``evaluation.json`` says that it is of these weights; episodes of each policy, 0 without one.

    ``None`` if it says that it is of others.
    """
    with values_of(str(files.root / place / "evaluation.json"), "measure the run again."):
        found = files.json(f"{place}evaluation.json") or {}
        of = (found.get("protocol") or {}).get("updates")
        if of is not None and updates is not None and of != updates:
            return None
        episodes = (int(one.get("episodes", 0)) for one in (found.get("policies") or {}).values())
        return of is not None, max(episodes, default=0)


def _copy_json(source: Path, target: Path) -> None:
    """Unchanged, unless there are absolute paths in it."""
    text = UntrustedFolder(source.parent).text(source.name) or ""
    try:
        value = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise UserError(
            f"publish: {source} cannot be read ({error}); write it again, or remove it"
        ) from error
    cleaned = without_paths(value)
    target.write_text(text if cleaned == value else json.dumps(cleaned, indent=1), encoding="utf-8")
