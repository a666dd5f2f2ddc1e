"""Datasets to the Hugging Face Hub, privately unless told otherwise."""

from __future__ import annotations

import contextlib
import json
import shutil
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

from franka_wm.data.lerobot.card import IMAGE, dataset_card, make_image
from franka_wm.data.lerobot.hub import check_license, check_repo_id, explained
from franka_wm.data.lerobot.paths import without_paths
from franka_wm.data.lerobot.provenance import read_provenance
from franka_wm.data.lerobot.schema import PROVENANCE
from franka_wm.data.lerobot.source import VERSION_TAG, check_finite
from franka_wm.errors import UserError
from franka_wm.untrusted import linked_json

README = "README.md"


def publish_dataset(
    root: str | Path,
    repo_id: str,
    *,
    private: bool = True,
    license: str = "apache-2.0",
    update: bool = False,
    dry_run: bool = False,
) -> None:
    """Sends a dataset with our card, and sets the tag that LeRobot loads.

    What arrives is what LeRobot's ``push_to_hub`` would send, except for the card: it writes a generated one over
    the one that is there. It also leaves files of an earlier version, which are removed here.

    Args:
        root: A LeRobot dataset on disk. Nothing in it is changed: card and image are made elsewhere, and go in the
            place of a README.md that is there.
        repo_id: ``user/name``.
        private: Whether only you can see it.
        license: License of the data, as the Hub names it (:data:`~franka_wm.data.lerobot.hub.LICENSES`).
        update: Allow a repository that exists; files in it that the dataset has not are removed.
        dry_run: Only say what would go, and write the card.

    Raises:
        UserError: One line: not a dataset, no token, the name is taken, no network.
    """
    root = Path(root).absolute()
    check_repo_id(repo_id)
    check_license(license)
    _check_dataset(root)
    note = ""
    if (root / README).is_file():
        note = f"the card replaces {README} in what is sent; {root / README} stays as it is"

    def stage(place: Path) -> Path:
        return stage_dataset(root, place, repo_id=repo_id, license=license)

    publish_staged(stage, repo_id, "dataset", private=private, update=update, dry_run=dry_run, note=note)


def published_before(repo_id: str, is_ours: Callable[[dict[str, Any]], bool]) -> bool:
    """Whether the Hub holds a dataset already that is ours; sets the tag that LeRobot loads where it is not there.

    What is sent arrives whole or not at all; a kill may only leave it without its tag.

    Args:
        repo_id: ``user/name``.
        is_ours: Judges the provenance that was published, which has no absolute paths.

    Raises:
        UserError: No token, no network.
    """
    from huggingface_hub.errors import RemoteEntryNotFoundError, RepositoryNotFoundError

    api = hub_client(repo_id)
    with explained(repo_id):
        try:
            path = Path(api.hf_hub_download(repo_id=repo_id, filename=PROVENANCE, repo_type="dataset"))
        except (RepositoryNotFoundError, RemoteEntryNotFoundError):
            return False
        if not is_ours(linked_json(path)):
            return False
        refs = api.list_repo_refs(repo_id=repo_id, repo_type="dataset")
        if VERSION_TAG not in {ref.name for ref in refs.tags}:
            _tag(api, repo_id)
    return True


def publish_staged(
    stage: Callable[[Path], Path],
    repo_id: str,
    kind: Literal["dataset", "model"],
    *,
    private: bool,
    update: bool,
    dry_run: bool,
    note: str = "",
) -> None:
    """Shows what would be sent, and sends it, or in a dry run writes its card.

    Args:
        stage: Puts what is sent into an empty folder.
        repo_id, private, update, dry_run: As for :func:`publish_dataset`.
        kind: Kind of the repository.
        note: Said before anything is sent.
    """
    from franka_wm.console import announced, say

    api = None if dry_run else hub_client(repo_id)
    with tempfile.TemporaryDirectory() as place:
        staged = stage(Path(place))
        files = files_of(staged)
        show_files(files, staged, repo_id, private, kind)
        if note:
            say(note)
        if api is None:
            write_card(staged, repo_id)
            return
        with explained(repo_id):
            check_name(api, repo_id, kind, private, update)
            with announced(f"sending {len(files)} files"):
                send(api, staged, repo_id, kind, private)
                if kind == "dataset":
                    _tag(api, repo_id)
    address = f"{api.endpoint}/{'datasets/' if kind == 'dataset' else ''}{repo_id}"
    say(f"published: {address} ({'private' if private else 'public'})")


def _check_dataset(root: Path) -> None:
    """Raises ``UserError`` unless it is a LeRobot dataset of the version that is published, with episodes."""
    path = root / "meta" / "info.json"
    if not path.is_file():
        raise UserError(
            f"publish: root={root} is not a LeRobot dataset (no meta/info.json); franka-wm collect out=FOLDER makes one"
        )
    info = linked_json(path)
    kinds = {"codebase_version": str, "total_episodes": int, "total_frames": int, "fps": int | float}
    kinds |= {"features": dict, "data_path": str}
    wrong = [key for key, kind in kinds.items() if not isinstance(info.get(key), kind)]
    features = {} if "features" in wrong else info["features"]
    wrong += [
        f"features.{name}"
        for name, one in features.items()
        if not isinstance(one, dict)
        or not isinstance(one.get("dtype"), str)
        or not isinstance(one.get("shape"), list)
    ]
    if any(one["dtype"] == "video" for name, one in features.items() if f"features.{name}" not in wrong):
        wrong += [] if isinstance(info.get("video_path"), str) else ["video_path"]
    if wrong:
        raise UserError(
            f"publish: {path} lacks {', '.join(wrong)}, or has another kind of value there; a LeRobot dataset has them"
        )
    if not info["total_episodes"]:
        raise UserError(f"publish: root={root} has no episodes")
    if info["codebase_version"] != VERSION_TAG:
        raise UserError(f"publish: root={root} is of version {info['codebase_version']}, not {VERSION_TAG}")


def stage_dataset(root: Path, place: Path, *, repo_id: str, license: str) -> Path:
    """Links to the files of a dataset, with a card and an image, and a provenance without absolute paths.

    Args:
        root: The dataset; is only read.
        place: An empty folder.
        repo_id, license: For the card.

    Returns:
        ``place``: what is published, file by file.

    Raises:
        UserError: A link in the dataset leads to what is not part of it, or a number in it is not finite.
    """
    _check_links(root)
    check_finite(root)
    for name in files_of(root):
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        if name not in (README, PROVENANCE, IMAGE):
            (place / name).symlink_to(root / name)
    provenance = read_provenance(root)
    if provenance is not None:
        cleaned = without_paths(provenance)
        if cleaned == provenance:
            shutil.copyfile(root / PROVENANCE, place / PROVENANCE)
        else:
            (place / PROVENANCE).write_text(json.dumps(cleaned, indent=1), encoding="utf-8")
    make_image(root, place / IMAGE)
    card = dataset_card(place, repo_id=repo_id, license=license)
    (place / README).write_text(card, encoding="utf-8")
    return place


def _check_links(root: Path) -> None:
    """Raises ``UserError`` at a pipe, or at a link to anything but a file of the dataset that is sent as well."""
    home = root.resolve()
    for path in sorted(root.rglob("*")):
        name = path.relative_to(root).as_posix()
        if not _goes(name):
            continue
        if not path.is_symlink():
            if not path.is_file() and not path.is_dir():
                raise UserError(f"publish: root={root}: {name} is no file; remove it")
            continue
        target = path.resolve()
        inside = target.is_file() and target.is_relative_to(home)
        if not inside or not _goes(target.relative_to(home).as_posix()):
            raise UserError(
                f"publish: root={root}: {name} is a link to {target}, which is no file of the dataset; "
                "copy the file to where the link is, or remove the link"
            )


# -- the Hub -------------------------------------------------------------------------------------------------------


def files_of(root: Path) -> list[str]:
    """What goes, relative to ``root``: everything but recorders' scratch and what is hidden."""
    names = [path.relative_to(root).as_posix() for path in sorted(root.rglob("*")) if path.is_file()]
    return [name for name in names if _goes(name)]


def _goes(name: str) -> bool:
    return not name.startswith(("images/", ".")) and "/." not in name


def show_files(files: Sequence[str], root: Path, repo_id: str, private: bool, kind: str) -> None:
    from franka_wm.console import count, say

    size = sum((root / name).stat().st_size for name in files)
    say(f"{kind} {repo_id} ({'private' if private else 'public'}): {len(files)} files, {count(size)}B")
    for name in files:
        say(f"  {name}   {count((root / name).stat().st_size)}B")


def write_card(staged: Path, repo_id: str) -> None:
    """The end of a dry run: the card and its image, to look at, in a folder of their own."""
    from franka_wm.console import say

    place = Path("outputs") / "publish" / repo_id.replace("/", "--")
    for name in (README, IMAGE):
        if (staged / name).is_file():
            (place / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(staged / name, place / name)
    say(f"dry run: nothing was sent; the card: {place / README}")


def hub_client(repo_id: str) -> Any:
    """The Hub's client; the token is its own business."""
    from huggingface_hub import HfApi, constants, get_token

    if constants.HF_HUB_OFFLINE:
        raise UserError(f"publish: HF_HUB_OFFLINE is set, so nothing can be sent to {repo_id}; unset it")
    if not get_token():
        raise UserError("publish: no token for the Hub; log in with: hf auth login (or set HF_TOKEN)")
    return HfApi()


def check_name(api: Any, repo_id: str, kind: str, private: bool, update: bool) -> None:
    """Raises ``UserError`` if the repository holds something and is not to be changed, or if anybody could see it.

    One that holds nothing is taken: an upload that failed has left it.
    """
    from huggingface_hub.errors import GatedRepoError, RepositoryNotFoundError

    try:
        there = api.repo_info(repo_id=repo_id, repo_type=kind)
    except GatedRepoError:  # it is there, and not ours
        raise
    except RepositoryNotFoundError:
        return
    if not update and {one.rfilename for one in there.siblings or ()} - {".gitattributes"}:
        raise UserError(
            f"publish: {repo_id} exists already; choose another repo_id, or replace what is there with update=true"
        )
    if private and not there.private:  # the Hub keeps what it is
        raise UserError(
            f"publish: {repo_id} is public; give private=false, make it private on the Hub, or choose another repo_id"
        )
    if there.private and not private:
        raise UserError(
            f"publish: {repo_id} is private; give private=true, make it public on the Hub, or choose another repo_id"
        )


def send(api: Any, folder: Path, repo_id: str, kind: str, private: bool) -> None:
    """All of a staged folder, which has what :func:`files_of` lists and no more, in one commit. What an
    earlier version left there goes in it: readers would take it for ours."""
    api.create_repo(repo_id=repo_id, private=private, repo_type=kind, exist_ok=True)
    api.upload_folder(
        repo_id=repo_id,
        folder_path=folder,
        repo_type=kind,
        ignore_patterns=["images/", ".*", "*/.*"],
        delete_patterns="*",
        commit_message="Upload with franka-wm",
    )


def _tag(api: Any, repo_id: str) -> None:
    """Moves the tag to the newest commit, and checks that it is there."""
    from huggingface_hub.errors import RevisionNotFoundError

    with contextlib.suppress(RevisionNotFoundError):  # a new repository has none
        api.delete_tag(repo_id, tag=VERSION_TAG, repo_type="dataset")
    api.create_tag(repo_id, tag=VERSION_TAG, repo_type="dataset")
    refs = api.list_repo_refs(repo_id=repo_id, repo_type="dataset")
    tagged = {ref.name: ref.target_commit for ref in refs.tags}.get(VERSION_TAG)
    newest = {ref.name: ref.target_commit for ref in refs.branches}.get("main")
    if tagged is None or tagged != newest:
        raise UserError(
            f"publish: the tag {VERSION_TAG} of {repo_id} is not at its newest version, so LeRobot would not load "
            "it; run the same command again with update=true"
        )
