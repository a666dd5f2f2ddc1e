"""The Hugging Face Hub: downloads that execute nothing, and its errors in one line. Tokens are never shown."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path

from franka_wm.errors import UserError

SAFE = ("*.safetensors", "*.json", "*.yaml")
"""Files of a published model that are downloaded: tensors and plain values."""

_NAME = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")


def check_repo_id(repo_id: str) -> None:
    """Raises ``UserError`` unless it is ``user/name``."""
    if not _NAME.fullmatch(repo_id) or ".." in repo_id or "--" in repo_id:
        raise UserError(f"repo_id={repo_id!r}: must be user/name, of letters, digits, '-', '_' and '.'")


_LICENSES = (
    "apache-2.0 mit afl-3.0 artistic-2.0 bsl-1.0 isc ms-pl ncsa postgresql unlicense wtfpl zlib bsd "
    "bsd-2-clause bsd-3-clause bsd-3-clause-clear ecl-2.0 epl-1.0 epl-2.0 etalab-2.0 eupl-1.1 eupl-1.2 "
    "agpl-3.0 gpl gpl-2.0 gpl-3.0 lgpl lgpl-2.1 lgpl-3.0 lgpl-lr gfdl lppl-1.3c mpl-2.0 ofl-1.1 "
    "osl-3.0 c-uda cdla-sharing-1.0 odbl odc-by cdla-permissive-1.0 cdla-permissive-2.0 pddl cc "
    "cc0-1.0 cc-by-2.0 cc-by-2.5 cc-by-3.0 cc-by-4.0 cc-by-sa-3.0 cc-by-sa-4.0 cc-by-nc-2.0 "
    "cc-by-nc-3.0 cc-by-nc-4.0 cc-by-nd-4.0 cc-by-nc-nd-3.0 cc-by-nc-nd-4.0 cc-by-nc-sa-2.0 "
    "cc-by-nc-sa-3.0 cc-by-nc-sa-4.0 openrail openrail++ bigscience-openrail-m bigcode-openrail-m "
    "creativeml-openrail-m openmdw-1.0 openmdw-1.1 unknown other"
)
LICENSES = tuple(_LICENSES.split())
"""Identifiers of https://huggingface.co/docs/hub/repositories-licenses, without those of one company's models."""


def check_license(license: str) -> None:
    """Raises ``UserError`` unless the Hub knows the identifier."""
    if license not in LICENSES:
        near = get_close_matches(license.lower(), LICENSES, n=1)
        raise UserError(
            f"license={license}: no identifier of the Hub{f'; did you mean {near[0]}?' if near else ''}; use "
            "apache-2.0, mit, cc-by-4.0 or another of https://huggingface.co/docs/hub/repositories-licenses, or other"
        )


def download_model(repo_id: str) -> Path:
    """A published model, in the Hub's own cache: only safetensors, JSON and YAML, whatever else is there.

    Args:
        repo_id: ``user/name``, or ``user/name@revision``: a branch, tag or commit.

    Returns:
        Its folder.

    Raises:
        UserError: No such repository, no access, no network, or nothing in it that could be a model.
    """
    from huggingface_hub import snapshot_download

    repo_id, _, revision = repo_id.partition("@")
    check_repo_id(repo_id)
    with explained(repo_id):
        folder = Path(snapshot_download(repo_id, revision=revision or None, allow_patterns=list(SAFE)))
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
                f"{repo_id}: the Hub refuses the token (status {status}); log in with one that has the right: "
                "hf auth login"
            ) from error
        raise UserError(f"{repo_id}: the Hub answered with status {status}; try again later") from error
    except (LocalEntryNotFoundError, httpx.TransportError, ConnectionError) as error:
        raise UserError(
            f"{repo_id}: the Hub cannot be reached; check the network, then run it again"
        ) from error
    except OSError as error:
        reason = (str(error).strip().splitlines() or [""])[0]
        raise UserError(f"{repo_id}: cannot be fetched or sent ({type(error).__name__}: {reason})") from error
