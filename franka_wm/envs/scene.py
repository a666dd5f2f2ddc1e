"""What stands around the arm, as data: a table, bodies that move freely, obstacles that do not.

A scene is made of frozen, validated dataclasses, or of the same names in YAML::

    scene:
      table: {height: 0.0}
      objects:
        - {name: cube, shape: box, size: [0.04, 0.04, 0.04], mass: 0.05, at: [0.5, 0.0], spread: [0.1, 0.15]}
      obstacles:
        - {name: wall, shape: box, size: [0.02, 0.3, 0.1], at: [0.6, 0.0, 0.05]}
"""

from __future__ import annotations

import math
import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Self

from franka_wm.errors import UserError
from franka_wm.options import is_real

SIZES = {
    "box": ("length", "width", "height"),
    "cylinder": ("radius", "height"),
    "sphere": ("radius",),
    "capsule": ("radius", "height"),
}
"""Shapes, and what the numbers of their ``size`` mean, in metres; a capsule's height is between its half spheres."""

REACH = (0.25, 0.80)
"""Horizontal distance from the base at which objects may start [m]: nearer is the arm itself, farther no reach."""

FLOOR = -0.75
"""Height of the ground, which the table stands on [m]."""

ATTEMPTS = 64
"""How often an object's place is drawn anew because something stands there already."""


@dataclass(frozen=True, kw_only=True)
class Solid:
    """A shape that is touched and seen.

    Attributes:
        name: Of letters, digits and _; each only once in a scene.
        shape: ``box``, ``cylinder``, ``sphere`` or ``capsule``; round ones stand upright.
        size: As :data:`SIZES` says [m].
        friction: Coefficient of sliding friction; of two solids that touch, the larger one counts. The fingers' is 1.
        color: Red, green, blue, from 0 to 1.
    """

    name: str
    shape: str = "box"
    size: tuple[float, ...] = (0.04, 0.04, 0.04)
    friction: float = 0.4
    color: tuple[float, float, float] = (0.80, 0.20, 0.18)

    def __post_init__(self) -> None:
        where = self._where
        if not isinstance(self.name, str) or not self.name.isidentifier():
            raise UserError(f"scene: name={self.name!r}: must be made of letters, digits and _, such as cube")
        if self.shape not in SIZES:
            raise UserError(f"{where}.shape={self.shape!r}: must be one of {', '.join(SIZES)}")
        meaning = SIZES[self.shape]
        size = self._numbers("size", len(meaning), f"{', '.join(meaning)} in metres")
        if not all(0.001 <= s <= 5.0 for s in size):
            raise UserError(f"{where}.size={list(size)}: {', '.join(meaning)} must be from 0.001 to 5 m each")
        if not is_real(self.friction) or not 0 <= self.friction <= 10:
            raise UserError(f"{where}.friction={self.friction!r}: must be from 0 to 10")
        if not all(0 <= c <= 1 for c in self._numbers("color", 3, "red, green, blue")):
            raise UserError(f"{where}.color={list(self.color)}: red, green and blue must be from 0 to 1")

    @property
    def _where(self) -> str:
        return f"scene.{self.name}"

    def _numbers(self, field: str, count: int, what: str) -> tuple[float, ...]:
        """The field as ``count`` floats; it may be given as a list."""
        value = getattr(self, field)
        ok = isinstance(value, Sequence) and not isinstance(value, str) and len(value) == count
        if not ok or not all(is_real(v) for v in value):
            raise UserError(f"{self._where}.{field}={value!r}: give {count} numbers ({what})")
        object.__setattr__(self, field, tuple(float(v) for v in value))
        return getattr(self, field)

    @property
    def half_height(self) -> float:
        """From the centre to what it stands on [m]."""
        if self.shape == "capsule":
            return self.size[0] + 0.5 * self.size[1]
        return self.size[0] if self.shape == "sphere" else 0.5 * self.size[-1]

    @property
    def radius(self) -> float:
        """Of the upright cylinder that holds it [m]."""
        return 0.5 * math.hypot(*self.size[:2]) if self.shape == "box" else self.size[0]

    @property
    def volume(self) -> float:
        """[m³]."""
        s = self.size
        if self.shape == "box":
            return s[0] * s[1] * s[2]
        ball = 4.0 / 3.0 * math.pi * s[0] ** 3
        if self.shape == "sphere":
            return ball
        return math.pi * s[0] ** 2 * s[1] + (ball if self.shape == "capsule" else 0.0)

    @classmethod
    def of(cls, values: Any) -> Self:
        """From a mapping, or one that is there already; an unknown name is an error that lists the known ones."""
        return values if isinstance(values, cls) else cls(**_known(cls, values))


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
        if not is_real(self.mass) or not 0.001 <= self.mass <= 50:
            raise UserError(f"{self._where}.mass={self.mass!r}: must be from 0.001 to 50 kg")
        self._numbers("at", 2, "x, y in metres")
        if not all(s >= 0 for s in self._numbers("spread", 2, "half-widths in x and y, in metres")):
            raise UserError(f"{self._where}.spread={list(self.spread)}: must be at least 0")
        if not is_real(self.turn) or not 0 <= self.turn <= math.pi:
            raise UserError(f"{self._where}.turn={self.turn!r}: must be from 0 to π")
        x, y = abs(self.at[0]), abs(self.at[1])
        far = math.hypot(x + self.spread[0], y + self.spread[1])
        near = math.hypot(max(x - self.spread[0], 0.0), max(y - self.spread[1], 0.0))
        if near < REACH[0] or far > REACH[1]:
            raise UserError(
                f"{self._where}: starts {near:.2f} to {far:.2f} m from the base; the arm reaches {REACH[0]} to "
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
        self._numbers("at", 3, "x, y, z in metres")
        if not is_real(self.angle):
            raise UserError(f"{self._where}.angle={self.angle!r}: must be a number [rad]")


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


@dataclass(frozen=True, kw_only=True)
class Scene:
    """What stands around the arm.

    Attributes:
        objects: That move freely, in the order in which they are observed.
        obstacles: That stand still.
        table: That everything stands on.
        space: Between circles around objects at the start, at least, and between them and obstacles [m].
    """

    objects: tuple[Body, ...] = ()
    obstacles: tuple[Obstacle, ...] = ()
    table: Table = Table()
    space: float = 0.01

    def __post_init__(self) -> None:
        for field, kind in (("objects", Body), ("obstacles", Obstacle)):
            given = getattr(self, field)
            if not isinstance(given, Sequence) or isinstance(given, str):
                raise UserError(f"scene.{field}={given!r}: must be a list")
            object.__setattr__(self, field, tuple(kind.of(one) for one in given))
        object.__setattr__(self, "table", Table.of(self.table))
        if not is_real(self.space) or not 0 <= self.space <= 1:
            raise UserError(f"scene.space={self.space!r}: must be from 0 to 1 m")
        names = [one.name for one in (self.table, *self.objects, *self.obstacles)]
        for name in names:
            if names.count(name) > 1:
                raise UserError(f"scene: {name} is there {names.count(name)} times; each name only once")
        self._check_room()

    @property
    def top(self) -> float:
        """Height of the table [m]."""
        return self.table.at[2]

    @classmethod
    def of(cls, values: Any) -> Scene:
        """From a mapping, or one that is there already."""
        return values if isinstance(values, cls) else cls(**_known(cls, values))

    def body(self, name: str) -> int:
        """Number of an object, by its name.

        Raises:
            UserError: There is none.
        """
        if not is_real(self.space) or not 0 <= self.space <= 1:
            raise UserError(f"scene.space={self.space!r}: must be from 0 to 1 m")
        names = [one.name for one in self.objects]
        if name not in names:
            raise UserError(f"scene: no object {name!r}; there are {', '.join(names) or 'none'}")
        return names.index(name)

    def blocked(self) -> list[tuple[float, ...]]:
        """What obstacles take of the table: (x, y, half sides, cosine and sine of the angle, radius around these)."""
        out = []
        for one in self.obstacles:
            if one.at[2] - one.half_height < self.top + 0.2:
                box = one.shape == "box"
                sides = (0.5 * one.size[0], 0.5 * one.size[1]) if box else (0.0, 0.0)
                turn = (math.cos(one.angle), math.sin(one.angle))
                out.append((*one.at[:2], *sides, *turn, 0.0 if box else one.radius))
        return out

    def _check_room(self) -> None:
        """Refuses a scene whose objects overlap, an obstacle or one another, in nearly every draw, or hang over."""
        table = self.table
        for body in self.objects:
            for k in range(2):
                reach = abs(body.at[k] - table.at[k]) + body.spread[k] + body.radius
                if reach > 0.5 * table.size[k]:
                    raise UserError(
                        f"scene.{body.name}: may start beyond the table's edge in {'xy'[k]}; change at or spread"
                    )
        generator, draws, good = random.Random(0), 32, 0
        for _ in range(draws):
            fixed, taken = self.blocked(), []
            for body in self.objects:
                for _ in range(ATTEMPTS):
                    x, y = (body.at[k] + generator.uniform(-1, 1) * body.spread[k] for k in range(2))
                    least = body.radius + self.space
                    if all(_distance(x, y, one) > least for one in fixed) and all(
                        math.hypot(x - a, y - b) > least + r for a, b, r in taken
                    ):
                        taken.append((x, y, body.radius))
                        break
                else:
                    stuck = body.name
                    break
            else:
                good += 1
        if good < draws:
            raise UserError(
                f"scene.{stuck}: stands in something else in {100 * (1 - good / draws):.0f} % of {draws} draws; "
                "move it (at), or draw from more room (spread)"
            )


def _distance(x: float, y: float, blocked: tuple[float, ...]) -> float:
    """From a point to what an obstacle takes [m], as the kernel that places objects has it."""
    a, b, half_u, half_v, cos, sin, radius = blocked
    u = max(abs(cos * (x - a) + sin * (y - b)) - half_u, 0.0)
    v = max(abs(cos * (y - b) - sin * (x - a)) - half_v, 0.0)
    return math.hypot(u, v) - radius


def _known(cls: type, values: Any) -> dict[str, Any]:
    if not isinstance(values, Mapping):
        raise UserError(f"scene: {values!r} must be a mapping of {', '.join(f.name for f in fields(cls))}")
    known = {f.name for f in fields(cls)}
    for name in values:
        if name not in known:
            what = f"scene.{values.get('name', cls.__name__.lower())}"
            raise UserError(f"{what}: unknown {name!r}; known: {', '.join(sorted(known))}")
    return dict(values)
