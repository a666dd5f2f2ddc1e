"""What stands around the arm, as data: a table, bodies that move freely, obstacles that do not, drawers and doors.

A scene is made of frozen, validated dataclasses, or of the same names in YAML::

    scene:
      table: {size: [1.1, 1.4, 0.05]}
      objects:
        - {name: cube, shape: box, size: [0.04, 0.04, 0.04], mass: 0.05, at: [0.5, 0.0], spread: [0.1, 0.15]}
      obstacles:
        - {name: wall, shape: box, size: [0.02, 0.3, 0.1], at: [0.6, 0.0, 0.05]}
      articulated:
        - {name: drawer, kind: drawer, travel: 0.2, at: [0.72, 0.0]}
        - {name: cabinet, file: cabinet.urdf, handle: handle, at: [0.72, 0.5]}
"""

from __future__ import annotations

import math
import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from franka_wm.envs.articulated import Articulated, box_on_table
from franka_wm.envs.articulated_file import ArticulatedFile
from franka_wm.envs.solids import REACH, SIZES, Body, Obstacle, Solid, Table, known_fields, short
from franka_wm.errors import UserError
from franka_wm.options import is_real

__all__ = [
    "FLOOR",
    "REACH",
    "SIZES",
    "Articulated",
    "ArticulatedFile",
    "Body",
    "Obstacle",
    "Scene",
    "Solid",
    "Table",
]

FLOOR = -0.75
"""Height of the ground, which the table stands on [m]."""

MOST_BODIES = 64
"""Most objects, obstacles, or drawers and doors: each costs time in every step, and moving bodies need a number in a
byte of a segmentation image."""

ATTEMPTS = 64
"""How often an object's place is drawn anew because something stands there already."""


@dataclass(frozen=True, kw_only=True)
class Scene:
    """What stands around the arm.

    Attributes:
        objects: That move freely, in the order in which they are observed.
        obstacles: That stand still.
        articulated: Drawers, doors and what opens from files, observed behind the objects.
        table: That everything stands on.
        space: Between circles around objects at the start, at least, and between them and obstacles [m].
    """

    objects: tuple[Body, ...] = ()
    obstacles: tuple[Obstacle, ...] = ()
    articulated: tuple[Articulated | ArticulatedFile, ...] = ()
    table: Table = field(default_factory=Table)
    space: float = 0.01

    def __post_init__(self) -> None:
        for name, make in (("objects", Body.of), ("obstacles", Obstacle.of), ("articulated", _articulated)):
            given = getattr(self, name)
            if not isinstance(given, Sequence) or isinstance(given, str):
                raise UserError(f"scene.{name}={short(given)}: must be a list")
            if len(given) > MOST_BODIES:
                raise UserError(f"scene.{name}: has {len(given)} bodies; the most is {MOST_BODIES}")
            object.__setattr__(self, name, tuple(make(one) for one in given))
        object.__setattr__(self, "table", Table.of(self.table))
        if not is_real(self.space) or not 0 <= self.space <= 1:
            raise UserError(f"scene.space={self.space!r}: must be from 0 to 1 m")
        names = [one.name for one in (self.table, *self.objects, *self.obstacles, *self.articulated)]
        names += [f"{one.name}_case" for one in self.articulated]
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
        if isinstance(values, str):  # env.scene=kitchen.yaml
            raise UserError(
                f"scene={short(values)}: must be a mapping, not the name of a file; write 'env.scene={{objects: "
                "[{name: cube}]}', or a preset in a folder of hydra.searchpath=: docs/tasks.md, A scene in a run"
            )
        return values if isinstance(values, cls) else cls(**known_fields(cls, values))

    def body(self, name: str) -> int:
        """Number of an object, by its name.

        Raises:
            UserError: There is none.
        """
        names = [one.name for one in self.objects]
        if name not in names:
            raise UserError(f"scene: no object {name!r}; there are {', '.join(names) or 'none'}")
        return names.index(name)

    def contacts(self, collisions: str) -> tuple[int, int]:
        """Contacts per world: the least with which everything stands still, and enough for what may happen.

        The hand rammed into a table and a cube makes 14. All worlds share one pool of this many each, so a crowded
        world may take from others' share, up to four times its own.

        Args:
            collisions: What of the robot touches the scene, as in the environment's config.
        """
        objects, obstacles, joints = len(self.objects), len(self.obstacles), len(self.articulated)
        parts = sum(len(one.hulls) for one in (*self.objects, *self.obstacles) if one.parts)
        least = 8 + 4 * objects
        enough = (
            8
            + 16 * (objects + joints)
            + 4 * obstacles
            + 2 * objects * (objects - 1)
            + 8 * objects * joints
            + 8 * parts
        )
        if collisions == "hand":
            return least, enough
        return least + 8, enough + 32 + 8 * (objects + obstacles + joints)

    def check_sizes(self, width: float) -> None:
        """Refuses a scene whose objects cannot have sizes from 1 − width to 1 + width of what it says.

        Raises:
            UserError: An object is a mesh, or the smallest or largest are not allowed or have no room.
        """
        for one in self.objects:
            if one.shape == "mesh":
                raise UserError(
                    f"randomization.object_size: scene.{one.name} is a mesh; MuJoCo keeps one hull for all worlds; "
                    "set it to 0"
                )
        for factor in (1 - width, 1 + width):
            try:
                objects = [replace(one, size=tuple(factor * s for s in one.size)) for one in self.objects]
                replace(self, objects=tuple(objects))
            except UserError as error:
                raise UserError(
                    f"randomization.object_size={width:g}: objects of {factor:g} times their size: {error}"
                ) from error

    def blocked(self, grown: float = 1.0) -> list[tuple[float, ...]]:
        """What obstacles take of the table: (x, y, half sides, cosine and sine of the angle, radius around these).

        Args:
            grown: How many times their size objects may have; then taller ones reach what hangs above.
        """
        out = []
        heights = [2 * grown * one.half_height for one in self.objects]
        heights += [one.size[2] for one in self.articulated]
        tallest = max([0.2, *heights])
        for one in self.obstacles:
            if self.top - one.half_height < one.at[2] < self.top + tallest + one.half_height:
                box = one.shape in ("box", "mesh", "socket")
                sides = tuple(0.5 * w for w in one.widths) if box else (0.0, 0.0)
                turn = (math.cos(one.angle), math.sin(one.angle))
                out.append((*one.at[:2], *sides, *turn, 0.0 if box else one.radius))
        return out

    @property
    def solids(self) -> list[tuple[float, ...]]:
        """Boxes around obstacles (x, y, z, half sides, cosine and sine of the angle) [m], where no goal is drawn: not
        of meshes and sockets, which may be mostly empty."""
        return [
            (
                *one.at,
                *(0.5 * w for w in one.widths),
                one.half_height,
                math.cos(one.angle),
                math.sin(one.angle),
            )
            for one in self.obstacles
            if one.shape not in ("mesh", "socket")
        ]

    def outline(self) -> list[tuple[float, float, float]]:
        """Corners of what a task may be about [m]: the table as far as the arm reaches, objects where they may start,
        drawers and doors where they may stand, open, and obstacles as far as the arm reaches."""
        top, far, table = self.top, REACH[1], self.table

        def on_table(*point: float) -> list[float]:
            """The point of the table that is nearest."""
            return [_within(point[i], table.at[i], 0.5 * table.size[i]) for i in range(2)]

        out = []
        if math.hypot(*on_table(0.0, 0.0), top) <= far:
            for k in range(32):
                x, y = on_table(far * math.cos(math.tau * k / 32), far * math.sin(math.tau * k / 32))
                out.append((x, y, top))
        for one in self.objects:
            u, v = (s + one.radius for s in one.spread)
            out += _corners((*one.at, u, v, 1.0, 0.0), top, top + 2 * one.half_height)
        for one in self.articulated:
            high = top + max(one.size[2], one.grip_at(one.travel)[2])
            for place in one.places():
                out += _corners(box_on_table(one, *place), top, high)
        for one in self.obstacles:
            if math.hypot(*one.at[:2]) - one.radius > far:
                continue
            u, v = (0.5 * w for w in one.widths)
            box = (*one.at[:2], u, v, math.cos(one.angle), math.sin(one.angle))
            corners = _corners(box, one.at[2] - one.half_height, one.at[2] + one.half_height)
            out += [
                (_within(x, 0.0, far), _within(y, 0.0, far), min(max(z, top), far)) for x, y, z in corners
            ]
        return out

    def _check_room(self) -> None:
        """Refuses a scene whose bodies overlap, an obstacle or one another, in any of some draws, or hang over."""
        table = self.table
        for body in self.objects:
            for k in range(2):
                reach = abs(body.at[k] - table.at[k]) + body.spread[k] + body.radius
                if reach > 0.5 * table.size[k]:
                    raise UserError(
                        f"scene.{body.name}: may start beyond the table's edge in {'xy'[k]}; change at or spread"
                    )
        for one in self.articulated:
            for corner in (corner for place in one.places() for corner in one.corners(*place)):
                for k in range(2):
                    if abs(corner[k] - table.at[k]) > 0.5 * table.size[k]:
                        raise UserError(
                            f"scene.{one.name}: its case may stand beyond the table's edge in {'xy'[k]}; change at, "
                            "spread, turn, or the table's size"
                        )
        # Where a case stands in the way of objects, only the next episode moves it.
        generator, draws = random.Random(0), 256 if self.articulated else 32
        stuck = [name for name in (self._draw(generator) for _ in range(draws)) if name]
        if stuck:
            raise UserError(
                f"scene.{stuck[-1]}: stands in something else in {100 * len(stuck) / draws:.0f} % of {draws} draws; "
                "move it (at), or draw from more room (spread)"
            )

    def _draw(self, generator: random.Random) -> str:
        """Places everything once, as the kernels do; the name of the first body without a place, or nothing."""
        fixed, taken = self.blocked(), []
        for one in self.articulated:
            for _ in range(ATTEMPTS):
                x, y = (one.at[k] + generator.uniform(-1, 1) * one.spread[k] for k in range(2))
                box = box_on_table(one, x, y, one.angle + generator.uniform(-1, 1) * one.turn)
                least = math.hypot(*one.footprint[2:]) + self.space
                if all(_distance(box[0], box[1], other) > least for other in fixed):
                    fixed.append(box)
                    break
            else:
                return one.name
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
                return body.name
        return ""


def _articulated(values: Any) -> Articulated | ArticulatedFile:
    """A drawer or a door, or what a file holds."""
    if isinstance(values, ArticulatedFile) or (
        isinstance(values, Mapping) and values.get("file") is not None
    ):
        return ArticulatedFile.of(values)
    return Articulated.of(values)


def _corners(box: Sequence[float], low: float, high: float) -> list[tuple[float, float, float]]:
    """Corners of a box on the table (x, y, half sides, cosine and sine of its angle) between two heights [m]."""
    x, y, half_u, half_v, cos, sin = box[:6]
    sides = [(i * half_u, j * half_v) for i in (-1, 1) for j in (-1, 1)]
    return [(x + cos * u - sin * v, y + sin * u + cos * v, z) for u, v in sides for z in (low, high)]


def _within(value: float, middle: float, half: float) -> float:
    return min(max(value, middle - half), middle + half)


def _distance(x: float, y: float, blocked: tuple[float, ...]) -> float:
    """From a point to what an obstacle takes [m], as the kernel that places objects has it."""
    a, b, half_u, half_v, cos, sin, radius = blocked
    u = max(abs(cos * (x - a) + sin * (y - b)) - half_u, 0.0)
    v = max(abs(cos * (y - b) - sin * (x - a)) - half_v, 0.0)
    return math.hypot(u, v) - radius
