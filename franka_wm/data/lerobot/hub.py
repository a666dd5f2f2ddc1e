"""The Hugging Face Hub: downloads that execute nothing, and its errors in one line. Tokens are never shown."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from franka_wm.errors import UserError

SAFE = ("*.safetensors", "*.json", "*.yaml")
"""Files of a published model that are downloaded: tensors and plain values."""

_NAME = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")


def check_repo_id(repo_id: str) -> None:
    """Raises ``UserError`` unless it is ``user/name``."""
    if not _NAME.fullmatch(repo_id) or ".." in repo_id or "--" in repo_id:
        raise UserError(f"repo_id={repo_id!r}: must be user/name, of letters, digits, '-', '_' and '.'")


def download(repo_id: str, *, revision: str | None = None) -> Path:
    """A published model, in the Hub's own cache: only safetensors, JSON and YAML, whatever else is there.

    Args:
        repo_id: ``user/name``, or ``user/name@revision``.
        revision: A branch, tag or commit.

    Returns:
        Its folder.

    Raises:
        UserError: No such repository, no access, no network, or nothing in it that could be a model.
    """
    from huggingface_hub import snapshot_download

    repo_id, _, given = repo_id.partition("@")
    check_repo_id(repo_id)
    with explained(repo_id):
        folder = Path(snapshot_download(repo_id, revision=given or revision, allow_patterns=list(SAFE)))
    if not (folder / "manifest.json").is_file():
        raise UserError(f"hf:{repo_id} holds no model of franka-wm (no manifest.json)")
    return folder


@contextmanager
def explained(repo_id: str) -> Iterator[None]:
    """Turns what the Hub and the network refuse into one line."""
    import httpx
    from huggingface_hub.errors import (
        GatedRepoError,
        HfHubHTTPError,
        LocalEntryNotFoundError,
        OfflineModeIsEnabled,
        RepositoryNotFoundError,
        RevisionNotFoundError,
    )

    try:
        yield
    except OfflineModeIsEnabled as error:
        raise UserError(f"{repo_id}: HF_HUB_OFFLINE is set, so the Hub cannot be asked; unset it") from error
    except GatedRepoError as error:
        raise UserError(f"{repo_id}: its owner must give you access first") from error
    except RepositoryNotFoundError as error:
        raise UserError(
            f"{repo_id}: no such repository on the Hub, or it is private and your token may not read it"
        ) from error
    except RevisionNotFoundError as error:
        raise UserError(f"{repo_id}: no such revision on the Hub") from error
    except HfHubHTTPError as error:
        status = error.response.status_code if error.response is not None else None
        if status in (401, 403):
            raise UserError(
                f"{repo_id}: the Hub refuses the token (status {status}); log in with a token that may write: "
                "hf auth login"
            ) from error
        raise UserError(f"{repo_id}: the Hub answered with status {status}; try again later") from error
    except (LocalEntryNotFoundError, httpx.TransportError, ConnectionError) as error:
        raise UserError(
            f"{repo_id}: the Hub cannot be reached; check the network, then run it again"
        ) from error
