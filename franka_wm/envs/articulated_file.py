"""Bodies with a joint from a URDF or MJCF file, as data: what stands, what moves, and how.

The file's axes are kept: z is up. The origin is the middle of the box around what stands still, at the height of its
lowest point, so that the case stands on the table.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from franka_wm.envs.articulated import Standing
from franka_wm.envs.mechanisms import Mechanism, read_mechanism
from franka_wm.envs.solids import EDGES, short
from franka_wm.errors import UserError
from franka_wm.options import is_real

MOST_TRAVEL = {True: (2.0, "m"), False: (math.tau, "rad")}
"""How far a joint may open, by whether it slides."""
STEPS = 32
"""Steps of the joint between which what it sweeps of the table is not looked at."""


@dataclass(frozen=True, kw_only=True)
class ArticulatedFile(Standing):
    """A case that stands on the table and what opens of it, from a file. Each episode draws anew where it stands.

    Geometry, masses, and the joint's limits, friction, damping and armature are the file's. It is closed at 0, or at
    the limit nearest to that, and opens to the limit that is farther away. All other joints are held where they are
    closed.

    Attributes:
        file: A URDF (``.urdf``) or MJCF (``.xml``) file. Its meshes (OBJ, STL) lie beside it or below; they are drawn,
            their convex hulls are touched.
        joint: Name of the joint that opens; needed where the file has several that move.
        handle: What is observed as the body's place: name of a link (the middle of its largest geometry), of a site or
            a geom, or a point (x, y, z) in the file's frame, closed, in the file's units.
        scale: Metres per unit of the file; masses go with its cube.
        color, case_color: Colours of what moves and of what stands, where the file has none.
    """

    joint: str | None = None
    handle: str | tuple[float, float, float] | None = None
    color: tuple[float, float, float] = (0.72, 0.45, 0.20)

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_stance()
        m, where = self.mechanism, self._where
        most, unit = MOST_TRAVEL[m.slides]
        for what, value, low, high in (
            (f"opens by {m.travel:g} {unit}", m.travel, 0.01, most),
            (f"has a mass of {m.mass:g} kg", m.mass, 0.01, 50.0),
            (f"has a friction of {m.friction:g}", m.friction, 0.0, 100.0),
            (f"has a damping of {m.damping:g}", m.damping, 0.0, 1000.0),
            (f"has an armature of {m.armature:g}", m.armature, 0.0, 100.0),
        ):
            if not low <= value <= high:
                raise UserError(f"{where}: what moves {what}; must be from {low:g} to {high:.4g}")
        self._check_reach({"closed": self.grip, "open": self.grip_at(self.travel)})

    def _take_file(self) -> None:
        """What moves and what stands from the file."""
        where = self._where
        for name, unsaid in (("shape", "box"), ("parts", None)):
            if (given := getattr(self, name)) != unsaid:
                raise UserError(f"{where}.{name}={short(given)}: follows from the file; leave it out")
        if not isinstance(self.file, str) or not self.file:
            raise UserError(f"{where}.file={self.file!r}: must be the path of a .urdf or .xml file")
        if self.joint is not None and not isinstance(self.joint, str):
            raise UserError(f"{where}.joint={self.joint!r}: must be the name of a joint")
        if isinstance(self.handle, Sequence) and not isinstance(self.handle, str):
            self._numbers("handle", 3, "a point, or the name of a link or site")
        elif not isinstance(self.handle, str) or not self.handle:
            raise UserError(f"{where}.handle={self.handle!r}: give the name of a link or site, or a point")
        if not is_real(self.scale) or not 1e-3 <= self.scale <= 1e3:
            raise UserError(f"{where}.scale={self.scale!r}: must be one number from 0.001 to 1000")
        object.__setattr__(self, "scale", float(self.scale))
        try:
            size = self.mechanism.size
        except UserError as error:
            raise UserError(f"{where}.file={error}") from error
        if not isinstance(self.size, Sequence) or tuple(self.size) not in (EDGES, size):
            raise UserError(
                f"{where}.size={short(self.size)}: follows from the file; leave it out, give scale"
            )
        if not all(0.01 <= s <= 5.0 for s in size):
            sides = " × ".join(f"{s:.4g}" for s in size)
            raise UserError(f"{where}: its case is {sides} m; it must be from 0.01 to 5 m each: change scale")
        object.__setattr__(self, "size", size)

    @cached_property
    def mechanism(self) -> Mechanism:
        """What the file holds, read once."""
        assert self.file is not None and self.handle is not None and isinstance(self.scale, float)
        return read_mechanism(self.file, joint=self.joint, handle=self.handle, scale=self.scale)

    # -- the joint ------------------------------------------------------------------------------------------

    @property
    def slides(self) -> bool:
        """Whether it slides, as a drawer does, or turns."""
        return self.mechanism.slides

    @property
    def travel(self) -> float:
        """How far it opens [m or rad]."""
        return self.mechanism.travel

    @property
    def grip(self) -> tuple[float, float, float]:
        """Place of the handle where it is closed, in the case's frame [m]."""
        return self.mechanism.handle

    @property
    def bar(self) -> tuple[float, float]:
        """Thickness of the handle between the fingers [m], and the hand's angle around it [rad]."""
        return self.mechanism.bar

    @property
    def hinge(self) -> tuple[float, float, float]:
        """A point of the joint's axis, in the case's frame [m]; of one that slides the closed handle."""
        return self.grip if self.slides else self.mechanism.hinge

    @property
    def axis(self) -> tuple[float, float, float]:
        """Along which it opens, or around which, in the case's frame."""
        return self.mechanism.axis

    def grip_at(self, opened: float) -> tuple[float, float, float]:
        """Place of the handle where the joint stands at ``opened`` [m or rad], in the case's frame [m]."""
        x, y, z = self.mechanism.moved(np.array([self.grip]), opened)[0].tolist()
        return (x, y, z)

    # -- room -----------------------------------------------------------------------------------------------

    @property
    def footprint(self) -> tuple[float, float, float, float]:
        """What it takes of the table, opened at any width, in the case's frame: centre x, y, half sides [m]."""
        return self._swept

    @cached_property
    def _swept(self) -> tuple[float, float, float, float]:
        m = self.mechanism
        moving = np.concatenate([part.corners for part in m.moving])
        places = [m.moved(moving, self.travel * k / STEPS) for k in range(STEPS + 1)]
        everything = np.concatenate([*(part.corners for part in m.case), *places])[:, :2]
        low, high = everything.min(0), everything.max(0)
        (x, y), (u, v) = (0.5 * (low + high)).tolist(), (0.5 * (high - low)).tolist()
        return (x, y, u, v)
