"""Solids of a scene, as data: what moves freely, what stands still, the table."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from typing import Any, Self

import numpy as np

from franka_wm.envs.mesh_solids import Surface, read_parts, read_surface
from franka_wm.errors import UserError
from franka_wm.options import did_you_mean, is_real

SIZES = {
    "box": ("length", "width", "height"),
    "cylinder": ("radius", "height"),
    "sphere": ("radius",),
    "capsule": ("radius", "height"),
    "socket": ("edge", "hole", "height"),
    "mesh": ("length", "width", "height"),
}
"""Shapes, and what the numbers of their ``size`` mean, in metres. A capsule's height is between its half spheres; a
socket is a square block with a square hole from above, down to a plate; a mesh's follow from its file."""

EDGES = (0.04, 0.04, 0.04)
"""Size of a box where nothing is said [m]."""

PLATE = 0.005
"""Thickness of what is under a socket's hole [m]."""

REACH = (0.25, 0.80)
"""Horizontal distance from the base at which objects may start [m]: nearer is the arm itself, farther no reach."""

FARTHEST = 10.0
"""Largest coordinate of what stands still [m]."""

LONGEST_NAME = 64
"""Most characters of a name."""

Box = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Centre and full sides of a box along the axes [m]."""


@dataclass(frozen=True, kw_only=True)
class Solid:
    """A shape that is touched and seen.

    Attributes:
        name: Letters, digits and _; each only once in a scene.
        shape: ``box``, ``cylinder``, ``sphere``, ``capsule``, ``socket`` or ``mesh``; round ones stand upright.
        size: As :data:`SIZES` says [m]; of a mesh that of the box around it, whose middle is the solid's place.
        file: File of a mesh: a closed surface (OBJ, STL or PLY), its z up. It is drawn; its convex hull is touched.
        parts: File of a mesh's convex parts, in place and units of ``file``: an OBJ or PLY. Each connected part
            of it is touched as its hull. ``None``: the hull of the whole is, and what is hollow is full.
        scale: Scale of a mesh: metres per unit of the file, one number or one along each of x, y and z.
        friction: Coefficient of sliding friction; of two solids that touch, the larger one counts. The fingers' is 1.
        color: Red, green, blue, from 0 to 1.
    """

    name: str
    shape: str = "box"
    size: tuple[float, ...] = EDGES
    file: str | None = None
    parts: str | None = None
    scale: float | tuple[float, float, float] = 1.0
    friction: float = 0.4
    color: tuple[float, float, float] = (0.80, 0.20, 0.18)

    def __post_init__(self) -> None:
        where = self._where
        if not isinstance(self.name, str) or not self.name.isidentifier():
            raise UserError(f"scene: name={self.name!r}: must be made of letters, digits and _, such as cube")
        if len(self.name) > LONGEST_NAME:
            raise UserError(f"scene: name={self.name[:20]}…: must have at most {LONGEST_NAME} characters")
        if not isinstance(self.shape, str) or self.shape not in SIZES:
            raise UserError(f"{where}.shape={self.shape!r}: must be one of {', '.join(SIZES)}")
        self._take_file()
        meaning = SIZES[self.shape]
        size = self._numbers("size", len(meaning), f"{', '.join(meaning)} in metres")
        if not all(0.001 <= s <= 5.0 for s in size):
            raise UserError(f"{where}.size={list(size)}: {', '.join(meaning)} must be from 0.001 to 5 m each")
        if self.shape == "socket" and (size[1] > size[0] - 0.004 or size[2] < 2 * PLATE):
            raise UserError(
                f"{where}.size={list(size)}: the hole must leave walls of 2 mm, the height be at least {2 * PLATE:g} m"
            )
        self._real("friction", 0, 10, "0 to 10")
        if not all(0 <= c <= 1 for c in self._numbers("color", 3, "red, green, blue")):
            raise UserError(f"{where}.color={list(self.color)}: red, green and blue must be from 0 to 1")

    def _take_file(self) -> None:
        """The size of a mesh from its file."""
        where = self._where
        if self.shape != "mesh":
            for name in ("file", "parts"):
                if getattr(self, name) is not None:
                    raise UserError(
                        f"{where}.{name}={short(getattr(self, name))}: is for shape: mesh, this is a {self.shape}"
                    )
            return
        if not isinstance(self.file, str) or not self.file:
            raise UserError(f"{where}.file={self.file!r}: a mesh needs the path of an OBJ, STL or PLY file")
        if is_real(self.scale):
            object.__setattr__(self, "scale", (self.scale,) * 3)
        scale = self._numbers("scale", 3, "or one, metres per unit of the file")
        if not all(1e-6 <= f <= 1e6 for f in scale):
            raise UserError(f"{where}.scale={list(scale)}: must be from 1e-6 to 1e6")
        try:
            size = self.surface.size
        except UserError as error:
            raise UserError(f"{where}.file={error}") from error
        if tuple(self.size) not in (EDGES, size):
            raise UserError(
                f"{where}.size={list(self.size)}: follows from a mesh's file; leave it out, give scale"
            )
        if not all(0.001 <= s <= 5.0 for s in size):
            sides = " × ".join(f"{s:.4g}" for s in size)
            raise UserError(
                f"{where}: its mesh is {sides} m; it must be from 0.001 to 5 m each: change scale"
            )
        object.__setattr__(self, "size", size)
        if self.parts is not None:
            if not isinstance(self.parts, str) or not self.parts:
                raise UserError(
                    f"{where}.parts={short(self.parts)}: must be the path of an OBJ or PLY file, or null"
                )
            try:
                _ = self.hulls
            except UserError as error:
                raise UserError(f"{where}.parts={error}") from error

    @property
    def hulls(self) -> tuple[np.ndarray, ...]:
        """Corners (V, 3) of what is touched, each as its convex hull [m]: the parts of a mesh."""
        assert self.parts is not None and isinstance(self.scale, tuple)  # seen to at the start
        return read_parts(self.parts, self.scale, self.surface)

    @property
    def surface(self) -> Surface:
        """Surface of a mesh."""
        assert self.file is not None and isinstance(self.scale, tuple)  # seen to at the start
        return read_surface(self.file, self.scale)

    @property
    def _where(self) -> str:
        return f"scene.{self.name}"

    def _numbers(self, field: str, count: int, what: str) -> tuple[float, ...]:
        """The field as ``count`` floats; it may be given as a list."""
        value = getattr(self, field)
        ok = isinstance(value, Sequence) and not isinstance(value, str) and len(value) == count
        if not ok or not all(is_real(v) for v in value):
            raise UserError(
                f"{self._where}.{field}={value!r}: give {count} number{'s' * (count > 1)} ({what})"
            )
        object.__setattr__(self, field, tuple(float(v) for v in value))
        return getattr(self, field)

    def _real(self, field: str, low: float, high: float, words: str) -> None:
        """Holds the field against a range, and makes it a float: Warp takes no whole number for one."""
        value = getattr(self, field)
        if not is_real(value) or not low <= value <= high:
            raise UserError(f"{self._where}.{field}={value!r}: must be from {words}")
        object.__setattr__(self, field, float(value))

    @property
    def half_height(self) -> float:
        """From the centre to what it stands on [m]."""
        if self.shape == "capsule":
            return self.size[0] + 0.5 * self.size[1]
        return self.size[0] if self.shape == "sphere" else 0.5 * self.size[-1]

    @property
    def radius(self) -> float:
        """Radius of the upright cylinder that holds it [m]."""
        if self.shape == "socket":
            return 0.5 * math.hypot(self.size[0], self.size[0])
        return 0.5 * math.hypot(*self.size[:2]) if self.shape in ("box", "mesh") else self.size[0]

    @property
    def widths(self) -> tuple[float, float]:
        """Along x and y [m]."""
        if self.shape in ("box", "mesh"):
            return self.size[0], self.size[1]
        edge = self.size[0] if self.shape == "socket" else 2.0 * self.size[0]
        return edge, edge

    @property
    def boards(self) -> list[Box]:
        """Boxes that a socket is made of, around its centre."""
        edge, hole, height = self.size
        wall, rise, z = 0.5 * (edge - hole), height - PLATE, 0.5 * PLATE
        side = 0.25 * (edge + hole)
        return [
            ((0.0, 0.0, 0.5 * (PLATE - height)), (edge, edge, PLATE)),
            ((side, 0.0, z), (wall, edge, rise)),
            ((-side, 0.0, z), (wall, edge, rise)),
            ((0.0, side, z), (hole, wall, rise)),
            ((0.0, -side, z), (hole, wall, rise)),
        ]

    @property
    def volume(self) -> float:
        """[m³]."""
        s = self.size
        if self.shape == "mesh":
            return self.surface.volume
        if self.shape == "box":
            return s[0] * s[1] * s[2]
        if self.shape == "socket":
            return s[0] ** 2 * s[2] - s[1] ** 2 * (s[2] - PLATE)
        ball = 4.0 / 3.0 * math.pi * s[0] ** 3
        if self.shape == "sphere":
            return ball
        return math.pi * s[0] ** 2 * s[1] + (ball if self.shape == "capsule" else 0.0)

    @classmethod
    def of(cls, values: Any) -> Self:
        """From a mapping, or one that is there already; an unknown name is an error that lists the known ones."""
        return values if isinstance(values, cls) else cls(**known_fields(cls, values))


@dataclass(frozen=True, kw_only=True)
class Body(Solid):
    """An object that moves freely. Each episode of each world draws anew where it stands.

    Attributes:
        mass: [kg].
        at: Middle of where it starts, (x, y) [m]; it stands upright on the table.
        spread: Half-width of the uniform draw around it in x and y [m].
        turn: Half-width of the draw of its angle around the vertical axis [rad].
    """

    mass: float = 0.05
    at: tuple[float, float] = (0.5, 0.0)
    spread: tuple[float, float] = (0.0, 0.0)
    turn: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self._real("mass", 0.001, 50, "0.001 to 50 kg")
        self._numbers("at", 2, "x, y in metres")
        if not all(s >= 0 for s in self._numbers("spread", 2, "half-widths in x and y, in metres")):
            raise UserError(f"{self._where}.spread={list(self.spread)}: must be at least 0")
        self._real("turn", 0, math.pi, "0 to π")
        x, y = abs(self.at[0]), abs(self.at[1])
        far = math.hypot(x + self.spread[0], y + self.spread[1])
        near = math.hypot(max(x - self.spread[0], 0.0), max(y - self.spread[1], 0.0))
        if near < REACH[0] or far > REACH[1]:
            place = f"{near:.2f} m" if f"{near:.2f}" == f"{far:.2f}" else f"{near:.2f} to {far:.2f} m"
            raise UserError(
                f"{self._where}: starts {place} from the base; the arm reaches {REACH[0]} to "
                f"{REACH[1]} m on the table: change at or spread"
            )


@dataclass(frozen=True, kw_only=True)
class Obstacle(Solid):
    """A solid that stands still.

    Attributes:
        at: Its centre, (x, y, z) [m].
        angle: Around the vertical axis [rad].
    """

    at: tuple[float, float, float] = (0.6, 0.0, 0.05)
    angle: float = 0.0
    color: tuple[float, float, float] = (0.45, 0.47, 0.50)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not all(abs(x) <= FARTHEST for x in self._numbers("at", 3, "x, y, z in metres")):
            raise UserError(
                f"{self._where}.at={list(self.at)}: must be from -{FARTHEST:g} to {FARTHEST:g} m each"
            )
        self._real("angle", -math.tau, math.tau, "-2π to 2π")


@dataclass(frozen=True, kw_only=True)
class Table(Obstacle):
    """The table that the arm is mounted on; its top is at height 0, the arm's base.

    Attributes:
        size: Length, width, thickness [m].
        at: Centre of its top [m].
    """

    name: str = "table"
    size: tuple[float, ...] = (1.10, 1.40, 0.05)
    at: tuple[float, float, float] = (0.35, 0.0, 0.0)
    color: tuple[float, float, float] = (0.66, 0.57, 0.47)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.shape != "box" or self.angle:
            raise UserError("scene.table: must be a box along the axes")


def short(value: Any) -> str:
    """A value in at most 100 characters, for a message."""
    text = repr(value)
    return text if len(text) <= 100 else f"{text[:99]}…"


def known_fields(cls: type, values: Any) -> dict[str, Any]:
    if not isinstance(values, Mapping):
        raise UserError(
            f"scene: {short(values)} must be a mapping of {', '.join(f.name for f in fields(cls))}"
        )
    known = {f.name for f in fields(cls)}
    for name in values:
        if name not in known:
            what = "scene" if cls.__name__ == "Scene" else f"scene.{values.get('name', cls.__name__.lower())}"
            hint = did_you_mean(str(name), sorted(known))
            raise UserError(f"{what}: unknown {name!r}; known: {', '.join(sorted(known))}{hint}")
    for one in fields(cls):
        if one.default is MISSING and one.default_factory is MISSING and one.name not in values:
            raise UserError(f"scene: {short(values)} has no {one.name}; give one")
    return dict(values)
