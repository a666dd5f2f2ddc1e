"""Where robots come from: for each name that ``robot=`` takes, a function that returns a URDF file.

To add a robot, write such a function and give it a line in :data:`SOURCES`; ``docs/robots.md`` shows how.
"""

from __future__ import annotations

import math
import os
from collections import UserDict
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, distribution
from importlib.resources import files
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import newton

from franka_wm.envs.mesh_solids import INSTALL
from franka_wm.errors import UserError
from franka_wm.options import is_real

if TYPE_CHECKING:
    from franka_wm.envs.config import FrankaConfig

PANDA = "cmeel.prefix/share/example-robot-data/robots/panda_description/urdf/panda.urdf"
"""The Panda inside the package ``example-robot-data``."""

CELL, COARSEST = 0.008, 0.03
"""Details of meshes smaller than this are not drawn [m] where nobody says otherwise: for people, and at most."""

PIXELS = 1.5
"""How many pixels of the observed images such a detail may span: ``docs/robots.md`` has what that costs and gains."""


@dataclass(frozen=True)
class Source:
    """A robot that can be named.

    Attributes:
        find: From the config to the URDF file; raises ``UserError`` if it cannot be had.
        cell: Details of meshes smaller than this are not drawn [m]; 0 draws every triangle. ``None``: as the config's
            ``mesh_detail`` says, see :func:`detail`.

    Raises:
        UserError: ``find`` is no function of the config alone, or ``cell`` no length.
    """

    find: Callable[[FrankaConfig], Path]
    cell: float | None = None

    def __post_init__(self) -> None:
        try:
            signature(self.find).bind("config")
        except (TypeError, ValueError) as error:  # ValueError: a built-in type
            raise UserError(
                f"Source({self.find!r}): must be a function that gives the path of a URDF for a FrankaConfig ({error})"
            ) from error
        if not (self.cell is None or (is_real(self.cell) and self.cell >= 0)):
            raise UserError(f"Source(…, cell={self.cell!r}): must be a length in metres, 0 for all, or None")


class Sources(UserDict[str, Source]):
    """Robots by name; those of the package stay what they are.

    Raises:
        UserError: One of them would be replaced, or the value is no :class:`Source`.
    """

    def __ior__(self, others: Any) -> Self:
        self.update(others)  # UserDict's own goes past `__setitem__`
        return self

    def __setitem__(self, name: str, source: Source) -> None:
        if not isinstance(source, Source):
            raise UserError(f"SOURCES[{name!r}]={source!r}: must be Source(FUNCTION), see docs/robots.md")
        if name in OURS and self.get(name, source) is not source:
            raise UserError(f"SOURCES[{name!r}]: the package has this robot; choose another name")
        super().__setitem__(name, source)


OURS = ("embedded", "newton_asset", "panda_meshes", "panda_meshes_full", "urdf")
"""Robots of the package."""


def embedded(config: FrankaConfig) -> Path:
    """The project's own FR3, drawn with primitives."""
    return Path(str(files(__package__) / "fr3.urdf"))


def newton_asset(config: FrankaConfig) -> Path:
    """A file of Newton's asset collection; downloaded once, then cached by Newton."""
    try:
        folder = Path(newton.utils.download_asset(config.asset_name))
    except ImportError as error:
        raise UserError(f"robot=newton_asset: the download needs GitPython; {INSTALL}") from error
    except Exception as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise UserError(
            f"robot=newton_asset: could not download {config.asset_name!r} ({reason}); use robot=embedded or "
            "robot=panda_meshes, which need no network, or robot=urdf with urdf_path=…"
        ) from error
    path = folder / config.urdf_relative_path
    if not path.is_file():
        raise UserError(
            f"urdf_relative_path={config.urdf_relative_path}: no such file in asset {config.asset_name!r} ({folder})"
        )
    return path


def panda_meshes(config: FrankaConfig) -> Path:
    """The Panda with Franka's own meshes, from the package ``example-robot-data``."""
    try:
        path = Path(str(distribution("example-robot-data").locate_file(PANDA)))
    except PackageNotFoundError as error:
        raise UserError(
            f"robot=panda_meshes needs the package example-robot-data; {INSTALL}, or use robot=embedded"
        ) from error
    if not path.is_file():
        raise UserError(f"robot=panda_meshes: this version of example-robot-data has no {path}; {INSTALL}")
    return path


def urdf(config: FrankaConfig) -> Path:
    """Whatever ``urdf_path`` names; without it there is nothing to load."""
    raise UserError("robot=urdf needs urdf_path=…, the URDF to load; or use robot=embedded")


SOURCES = Sources(
    {
        "embedded": Source(embedded),
        "newton_asset": Source(newton_asset),
        "panda_meshes": Source(panda_meshes),
        "panda_meshes_full": Source(panda_meshes, cell=0.0),
        "urdf": Source(urdf),
    }
)
"""The robots that ``robot=`` takes."""


def urdf_source(config: FrankaConfig, urdf_path: str | Path | None) -> Path:
    """The URDF file to load: ``urdf_path`` where given, else what the config names.

    Raises:
        UserError: If it does not exist or cannot be had; the message names the alternatives.
    """
    if urdf_path is None:
        found: object = SOURCES[config.robot].find(config)
        if not isinstance(found, str | Path) or not os.path.isfile(found):
            given = repr(str(found)) if isinstance(found, str | Path) else type(found).__name__
            raise UserError(
                f"robot={config.robot}: its function in SOURCES gave {given}; it must give the path of a URDF file "
                "that is there"
            )
        return Path(found)
    if not isinstance(urdf_path, str | Path) or not urdf_path:
        raise UserError(f"urdf_path={urdf_path!r}: must be the path of a URDF, or null")
    path = Path(urdf_path).expanduser()
    if not os.path.isfile(path):  # unlike Path.is_file, it takes names that no file can have
        raise UserError(
            f"urdf_path={path}: no such file; give a URDF with seven arm joints, or use robot=embedded"
        )
    return path


def detail(source: Source, config: FrankaConfig) -> float:
    """Size of the smallest detail of meshes that is drawn [m]: the source's, the config's, or a pixel and a half.

    Pixels of the observed images, where the fixed cameras look at; the wrist camera is closer to what it sees.
    """
    if source.cell is not None:
        return source.cell
    if config.mesh_detail is not None:
        return config.mesh_detail
    if not config.images or "wrist" in config.cameras:
        return CELL
    away = math.hypot(config.camera_distance, config.camera_height - config.camera_target_height)
    pixel = 2.0 * away * math.tan(0.5 * math.radians(config.camera_fov_degrees)) / config.image_size
    return min(PIXELS * pixel, COARSEST)
