"""The modules that the extras of the package bring, asked for before anything heavy is imported."""

from __future__ import annotations

from typing import Any

from franka_wm.errors import UserError


def import_viser() -> Any:
    """The module ``viser``.

    Raises:
        UserError: It is not installed; the message names the extra.
    """
    try:
        import viser
    except ImportError as error:
        raise UserError(f"the live page needs viser ({error}): pip install 'franka-wm[view]'") from error
    return viser


def import_rerun() -> Any:
    """The module ``rerun``.

    Raises:
        UserError: It is not installed; the message names the extra.
    """
    try:
        import rerun
    except ImportError as error:
        raise UserError(
            f"a recording for Rerun needs rerun-sdk ({error}): pip install 'franka-wm[rerun]'"
        ) from error
    return rerun
