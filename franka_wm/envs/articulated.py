"""Bodies with a joint, as data: a drawer that slides out of its case, a door that turns on its hinge.

Frames: x points to the back, z up; the origin is the middle of the case's footprint. So the front looks to −x, which
is towards the robot where the body stands before it and ``angle`` is 0.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass

from franka_wm.envs.solids import REACH, Box, Solid
from franka_wm.errors import UserError

KINDS = ("drawer", "door")

WALL = 0.012
"""Thickness of all boards [m]."""

PLAY = 0.003
"""Between what moves and what stands still [m]."""

INSIDE = 0.03
"""How much of a drawer stays in its case at least [m]."""


@dataclass(frozen=True, kw_only=True)
class Standing(Solid):
    """A case that stands on the table where each episode draws anew, and has something that opens.

    Attributes:
        at: Middle of where the case stands, (x, y) [m].
        angle: Its angle around the vertical axis [rad].
        spread: Half-width of the uniform draw around ``at`` in x and y [m].
        turn: Half-width of the draw around ``angle`` [rad].
        case_color: Colour of the case.
    """

    at: tuple[float, float] = (0.72, 0.0)
    angle: float = 0.0
    spread: tuple[float, float] = (0.0, 0.0)
    turn: float = 0.0
    case_color: tuple[float, float, float] = (0.36, 0.40, 0.46)

    def _check_stance(self) -> None:
        for name, count, what in (
            ("at", 2, "x, y in metres"),
            ("spread", 2, "half-widths in x and y, in metres"),
            ("case_color", 3, "red, green, blue"),
        ):
            self._numbers(name, count, what)
        self._real("angle", -math.pi, math.pi, f"{-math.pi:g} to {math.pi:g} (rad)")
        self._real("turn", 0.0, math.pi, f"0 to {math.pi:g} (rad)")
        if not all(s >= 0 for s in self.spread):
            raise UserError(f"{self._where}.spread={list(self.spread)}: must be at least 0")
        if not all(0 <= c <= 1 for c in self.case_color):
            raise UserError(
                f"{self._where}.case_color={list(self.case_color)}: red, green and blue must be from 0 to 1"
            )

    @property
    def footprint(self) -> tuple[float, float, float, float]:
        """What it takes of the table, opened at any width, in the case's frame: centre x, y, half sides [m]."""
        raise NotImplementedError

    def places(self) -> list[tuple[float, float, float]]:
        """Middle and corners of where the case may stand: x, y [m], angle [rad]."""
        return [
            (self.at[0] + i * self.spread[0], self.at[1] + j * self.spread[1], self.angle + k * self.turn)
            for i, j, k in itertools.product((-1, 0, 1), repeat=3)
        ]

    def corners(self, x: float, y: float, angle: float) -> list[tuple[float, float]]:
        """Corners of the case where it stands so [m]."""
        cos, sin = math.cos(angle), math.sin(angle)
        a, b = 0.5 * self.size[0], 0.5 * self.size[1]
        return [
            (x + cos * u - sin * v, y + sin * u + cos * v) for u, v in ((a, b), (a, -b), (-a, b), (-a, -b))
        ]

    def _check_reach(self, grips: Mapping[str, tuple[float, float, float]]) -> None:
        """Refuses a handle that the arm cannot reach where it is closed or open."""
        for opened, (gx, gy, _) in grips.items():
            for x, y, angle in self.places():
                cos, sin = math.cos(angle), math.sin(angle)
                away = math.hypot(x + cos * gx - sin * gy, y + sin * gx + cos * gy)
                if not REACH[0] <= away <= REACH[1]:
                    raise UserError(
                        f"{self._where}: its handle may be {away:.2f} m from the base where it is {opened}; the arm "
                        f"reaches {REACH[0]} to {REACH[1]} m on the table: change at, spread, turn or travel"
                    )


@dataclass(frozen=True, kw_only=True)
class Articulated(Standing):
    """A case that stands on the table, and a drawer or a door in it. Each episode draws anew where the case stands.

    The handle is an upright bar on two posts. What is observed as the body's place is the bar's middle.

    Attributes:
        kind: ``drawer``: slides out towards the front; ``door``: turns on a hinge at the left of the front, as one who
            stands before it sees it.
        size: Length (front to back), width, height of the case, with its front [m].
        handle: Distance of the bar's middle from the front, thickness and height of the bar [m].
        travel: How far it opens: metres of a drawer, radians of a door.
        mass: Mass of what moves [kg].
        joint_friction: Dry friction of the joint, N of a drawer, N·m of a door.
        joint_damping: N·s/m of a drawer, N·m·s/rad of a door.
        at: Middle of where the case stands, (x, y) [m].
        angle: Where its front looks to, around the vertical axis [rad].
        spread: Half-width of the uniform draw around ``at`` in x and y [m].
        turn: Half-width of the draw around ``angle`` [rad].
        color: Colour of what moves; the case has :attr:`case_color`.
    """

    kind: str = "drawer"
    size: tuple[float, ...] = (0.30, 0.34, 0.22)
    handle: tuple[float, float, float] = (0.05, 0.016, 0.07)
    travel: float = 0.20
    mass: float = 1.0
    joint_friction: float = 1.0
    joint_damping: float = 2.0
    color: tuple[float, float, float] = (0.72, 0.45, 0.20)

    def __post_init__(self) -> None:
        super().__post_init__()
        where = self._where
        if self.shape != "box":
            raise UserError(
                f"{where}.shape={self.shape!r}: a drawer or a door is made of boxes; leave it out"
            )
        if self.kind not in KINDS:
            raise UserError(f"{where}.kind={self.kind!r}: must be one of {', '.join(KINDS)}")
        self._numbers("handle", 3, "distance from the front, thickness, height of the bar, in metres")
        self._check_stance()
        for name, low, high, unit in (
            ("mass", 0.01, 50.0, "kg"),
            ("joint_friction", 0.0, 100.0, "N, or N·m of a door"),
            ("joint_damping", 0.0, 1000.0, "N·s/m, or N·m·s/rad of a door"),
        ):
            self._real(name, low, high, f"{low:g} to {high:g} ({unit})")
        if min(self.size) < 0.08:
            raise UserError(
                f"{where}.size={list(self.size)}: must be at least 0.08 m each; boards are {WALL} m thick"
            )
        away, thick, high = self.handle
        fits = 4 * WALL <= high <= self.size[2] - 2 * PLAY
        if not (0.004 <= thick <= 0.06 and thick <= away <= 0.2 and fits):
            raise UserError(
                f"{where}.handle={list(self.handle)}: thickness must be from 0.004 to 0.06 m, the distance from it to "
                f"0.2 m, the height from {4 * WALL:g} m to that of the front"
            )
        longest = self.size[0] - WALL - INSIDE if self.kind == "drawer" else math.pi
        unit = "m, so that the drawer stays in its case" if self.kind == "drawer" else "rad"
        self._real("travel", 0.01, longest, f"0.01 to {longest:.4g} {unit}")
        self._check_reach({"closed": self.grip, "open": self.grip_at(self.travel)})

    def _take_file(self) -> None:
        if self.file is not None:
            raise UserError(f"{self._where}.file={self.file!r}: a body from a file is an ArticulatedFile")

    # -- the joint ------------------------------------------------------------------------------------------

    @property
    def slides(self) -> bool:
        """A drawer, not a door."""
        return self.kind == "drawer"

    @property
    def grip(self) -> tuple[float, float, float]:
        """Middle of the handle's bar where it is closed, in the case's frame [m]."""
        length, width, height = self.size
        aside = 0.0 if self.slides else -0.5 * width + 0.03
        return (-0.5 * length - self.handle[0], aside, 0.5 * height)

    @property
    def bar(self) -> tuple[float, float]:
        """Thickness of the handle between the fingers [m], and the hand's angle around it [rad]."""
        return (self.handle[1], 0.0)

    @property
    def hinge(self) -> tuple[float, float, float]:
        """A point of the joint's axis, in the case's frame [m]; of a drawer the closed handle."""
        return self.grip if self.slides else (-0.5 * self.size[0], 0.5 * self.size[1], self.grip[2])

    @property
    def axis(self) -> tuple[float, float, float]:
        """Along which it opens, or around which, in the case's frame."""
        return (-1.0, 0.0, 0.0) if self.slides else (0.0, 0.0, -1.0)

    def grip_at(self, opened: float) -> tuple[float, float, float]:
        """Middle of the bar where the joint stands at ``opened`` [m or rad], in the case's frame [m]."""
        x, y, z = self.grip
        if self.slides:
            return (x - opened, y, z)
        dx, dy = x - self.hinge[0], y - self.hinge[1]
        cos, sin = math.cos(opened), math.sin(opened)
        return (self.hinge[0] + cos * dx + sin * dy, self.hinge[1] + cos * dy - sin * dx, z)

    # -- boards ---------------------------------------------------------------------------------------------

    @property
    def case(self) -> list[Box]:
        """Boards that stand still, in the case's frame."""
        length, width, height = self.size
        deep, middle = length - WALL, 0.5 * WALL  # behind the front
        side = 0.5 * (width - WALL)
        inner = width - 2 * WALL
        return [
            ((middle, side, 0.5 * height), (deep, WALL, height)),
            ((middle, -side, 0.5 * height), (deep, WALL, height)),
            ((middle, 0.0, 0.5 * WALL), (deep, inner, WALL)),
            ((middle, 0.0, height - 0.5 * WALL), (deep, inner, WALL)),
            ((0.5 * (length - WALL), 0.0, 0.5 * height), (WALL, inner, height - 2 * WALL)),
        ]

    @property
    def moving(self) -> list[Box]:
        """Boards that move: the front, the handle's bar and posts, a drawer's tray; from the bar's middle."""
        length, width, height = self.size
        away, thick, high = self.handle
        gx, gy, gz = self.grip
        front = -0.5 * length + 0.5 * WALL
        boxes: list[Box] = [
            ((front, 0.0, 0.5 * (height + PLAY)), (WALL, width, height - PLAY)),
            ((gx, gy, gz), (thick, thick, high)),
        ]
        post = (away - 0.5 * thick, 0.75 * thick, WALL)
        for end in (-1, 1):
            z = gz + end * 0.5 * (high - WALL)
            boxes.append(((gx + 0.5 * thick + 0.5 * post[0], gy, z), post))
        if self.slides:
            clear = WALL + PLAY
            begin, end = -0.5 * length + WALL, 0.5 * length - clear
            deep, middle = end - begin, 0.5 * (begin + end)
            wide, low = width - 2 * clear, 0.7 * (height - 2 * clear)
            z = clear + 0.5 * low
            boxes += [
                ((middle, 0.0, clear + 0.5 * WALL), (deep, wide, WALL)),
                ((middle, 0.5 * (wide - WALL), z), (deep, WALL, low)),
                ((middle, -0.5 * (wide - WALL), z), (deep, WALL, low)),
                ((end - 0.5 * WALL, 0.0, z), (WALL, wide - 2 * WALL, low)),
            ]
        return [((x - gx, y - gy, z - gz), size) for (x, y, z), size in boxes]

    @property
    def moving_volume(self) -> float:
        """[m³]."""
        return sum(math.prod(size) for _, size in self.moving)

    # -- room -----------------------------------------------------------------------------------------------

    @property
    def footprint(self) -> tuple[float, float, float, float]:
        """What it takes of the table, opened at any width, in the case's frame: centre x, y, half sides [m]."""
        length, width, _ = self.size
        away = self.handle[0] + self.handle[1]
        swing = self.travel if self.slides else width
        least_x, most_x = -0.5 * length - away - swing, 0.5 * length
        most_y = 0.5 * width
        if not self.slides:
            most_y += away + (width if self.travel > 0.5 * math.pi else 0.0)
        least_y = -0.5 * width
        center = (0.5 * (least_x + most_x), 0.5 * (least_y + most_y))
        return (*center, 0.5 * (most_x - least_x), 0.5 * (most_y - least_y))


def box_on_table(one: Standing, x: float, y: float, angle: float) -> tuple[float, ...]:
    """Its footprint where it stands so: x, y, half sides, cosine and sine of the angle, and 0, a radius around."""
    cx, cy, half_x, half_y = one.footprint
    cos, sin = math.cos(angle), math.sin(angle)
    return (x + cos * cx - sin * cy, y + sin * cx + cos * cy, half_x, half_y, cos, sin, 0.0)
