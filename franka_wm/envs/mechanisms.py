# pyright: reportAttributeAccessIssue=false
# (MuJoCo is compiled: pyright knows none of its names.)
"""Mechanisms from URDF and MJCF files: what stands still, and what one joint moves.

MuJoCo's own compiler reads both formats. Before it sees a file, everything is taken out that is not links, joints and
geometry, and meshes are read into memory, so that a file names nothing outside of its folder.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from franka_wm.envs.mechanism_files import Source, read_source
from franka_wm.envs.mesh_solids import Surface
from franka_wm.errors import UserError

if TYPE_CHECKING:
    import mujoco

MOST_PARTS = 256
"""Most geometries of a file: each costs time in every step."""
FARTHEST = 10.0
"""Largest coordinate [m]."""
UNSAID = (0.5, 0.5, 0.5, 1.0)
"""MuJoCo's colour of what has none."""
LAST_SEEN = 2
"""Last of MuJoCo's groups of geometries that its viewer shows where nobody says otherwise."""

Point = tuple[float, float, float]


@dataclass(frozen=True, eq=False, kw_only=True)
class Part:
    """A geometry of a link, in the case's frame, closed.

    Attributes:
        shape: ``box``, ``sphere``, ``cylinder``, ``capsule`` or ``mesh``.
        size: Half sides of a box, radius of a sphere, radius and half height of round ones [m].
        place: Its middle [m].
        rotation: (3, 3).
        color: Red, green, blue, from 0 to 1; ``None``: the file has none.
        touched, seen: Whether it collides, and whether it is drawn.
        surface: Triangles of a mesh.
        hull: Convex hull of a mesh that is touched.
        corners: (C, 3) points of which it lies in the convex hull [m].
    """

    shape: str
    size: tuple[float, ...]
    place: Point
    rotation: np.ndarray
    color: Point | None
    touched: bool
    seen: bool
    surface: Surface | None
    hull: Surface | None
    corners: np.ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class Mechanism:
    """What a file holds, in the case's frame: its origin is the middle of the case's box, at its lowest point.

    Attributes:
        case, moving: What stands still, and what the joint moves.
        size: Length, width, height of the box around the case [m].
        slides: Whether the joint slides, or turns.
        axis: Direction in which, or around which, it opens.
        hinge: A point of the axis [m].
        travel: How far it opens [m or rad].
        friction, damping, armature: What the joint has of each, in MuJoCo's units.
        mass, center, inertia: Mass of what moves [kg], its centre of mass [m], and (3, 3) about that [kg·m²].
        handle: Place of the handle [m].
        bar: Thickness of the handle between the fingers [m], and the hand's angle around it [rad].
    """

    case: tuple[Part, ...]
    moving: tuple[Part, ...]
    size: Point
    slides: bool
    axis: Point
    hinge: Point
    travel: float
    friction: float
    damping: float
    armature: float
    mass: float
    center: Point
    inertia: np.ndarray
    handle: Point
    bar: tuple[float, float]

    @property
    def has_meshes(self) -> bool:
        """Whether any mesh is touched."""
        return any(part.hull is not None for part in (*self.case, *self.moving))

    def moved(self, points: np.ndarray, opened: float) -> np.ndarray:
        """Points (P, 3) of what moves where the joint stands at ``opened`` [m or rad]."""
        axis = np.array(self.axis)
        if self.slides:
            return points + opened * axis
        away = points - self.hinge
        cos, sin = math.cos(opened), math.sin(opened)  # Rodrigues' formula
        along = (away @ axis)[:, None] * axis
        return self.hinge + cos * away + sin * np.cross(axis, away) + (1 - cos) * along


def read_mechanism(file: str, *, joint: str | None, handle: str | Point, scale: float) -> Mechanism:
    """The mechanism in a URDF or MJCF file.

    Args:
        file: Its path.
        joint: Name of the joint that opens; ``None``: the only one.
        handle: Name of a link, site or geom of what moves, or a point in the file's frame and units, closed.
        scale: Metres per unit of the file.

    Raises:
        UserError: The file is missing, or cannot be such a body; it says why.
    """
    source = read_source(file)
    try:
        return _Reader(source, joint, scale).mechanism(handle)
    except UserError as error:
        raise UserError(f"{file}: {error}") from error


class _Reader:
    """A compiled file, all joints closed; lengths in the file's units until :meth:`mechanism` returns."""

    def __init__(self, source: Source, joint: str | None, scale: float):
        import mujoco  # here: it takes a while, and most scenes need none

        self.scale, self.source = scale, source
        self.model = m = _compile(source)
        if m.ngeom > MOST_PARTS:
            raise UserError(f"has {m.ngeom} geometries; the most is {MOST_PARTS}")
        self.joint = self._choose(joint)
        self.data = mujoco.MjData(m)
        for j in range(m.njnt):
            self.data.qpos[m.jnt_qposadr[j]] = self._closed(j)
        mujoco.mj_kinematics(m, self.data)
        mujoco.mj_comPos(m, self.data)
        self.moves = np.zeros(m.nbody, dtype=bool)
        for body in range(1, m.nbody):  # parents come first
            self.moves[body] = body == m.jnt_bodyid[self.joint] or self.moves[m.body_parentid[body]]

    def mechanism(self, handle: str | Point) -> Mechanism:
        """All of it, moved to the case's frame."""
        m, d, j, s = self.model, self.data, self.joint, self.scale
        bare = not self.source.hides_colliders
        parts = {True: [], False: []}
        for geom in range(m.ngeom):
            touched = bool(m.geom_contype[geom] or m.geom_conaffinity[geom])
            seen = m.geom_group[geom] <= LAST_SEEN and _color(m, geom)[3] > 0 and (bare or not touched)
            if touched or seen:
                parts[bool(self.moves[m.geom_bodyid[geom]])].append((geom, touched, bool(seen)))
        for moving, what in ((False, "stands still"), (True, "moves")):
            if not parts[moving]:
                raise UserError(f"has no geometry that {what} where joint {m.joint(j).name!r} opens")
        corners = {geom: self._corners(geom) for group in parts.values() for geom, *_ in group}
        standing = np.concatenate([corners[geom] for geom, *_ in parts[False]])
        everything = np.concatenate(list(corners.values()))
        if not np.isfinite(everything).all() or abs(everything).max() * s > FARTHEST:
            raise UserError(f"reaches more than {FARTHEST:g} m away from its origin; change scale")
        low, high = standing.min(0), standing.max(0)
        origin = np.array([*(0.5 * (low + high))[:2], everything[:, 2].min()])

        def point(place: np.ndarray) -> Point:
            x, y, z = (s * (np.asarray(place) - origin)).tolist()
            return (x, y, z)

        def made(group: list[tuple[int, bool, bool]]) -> tuple[Part, ...]:
            return tuple(
                self._part(geom, touched, seen, point, s * (corners[geom] - origin))
                for geom, touched, seen in group
            )

        slides = m.jnt_type[j] == 2
        sign, travel = self._travel()
        dof = m.jnt_dofadr[j]
        grip, bar = self._handle(handle, [geom for geom, *_ in parts[True]], corners)
        x, y, z = (sign * d.xaxis[j]).tolist()
        length, width, height = (s * (high - low)).tolist()
        mass, center, inertia = self._inertia()
        return Mechanism(
            case=made(parts[False]),
            moving=made(parts[True]),
            size=(length, width, height),
            slides=bool(slides),
            axis=(x, y, z),
            hinge=point(d.xanchor[j]),
            travel=travel * (s if slides else 1.0),
            friction=float(m.dof_frictionloss[dof]),
            damping=float(m.dof_damping[dof]),
            armature=float(m.dof_armature[dof]),
            mass=s**3 * mass,
            center=point(center),
            inertia=s**5 * inertia,
            handle=point(grip),
            bar=(s * bar[0], bar[1]),
        )

    # -- the joint ------------------------------------------------------------------------------------------

    def _choose(self, name: str | None) -> int:
        m = self.model
        names = [m.joint(j).name for j in range(m.njnt)]
        for j in range(m.njnt):
            if m.jnt_type[j] not in (2, 3):  # free, ball
                raise UserError(f"joint {names[j]!r} neither slides nor turns about an axis; remove it")
        if not names:
            raise UserError("has no joint that moves")
        if name is None and len(names) > 1:
            raise UserError(
                f"has {len(names)} joints that move; say which one opens: joint: {', '.join(names)}"
            )
        if name is not None and name not in names:
            raise UserError(f"has no joint {name!r} that moves; there are {', '.join(names)}")
        j = 0 if name is None else names.index(name)
        if not m.jnt_limited[j]:
            raise UserError(f"joint {names[j]!r} has no limits; give it some, it opens from one to the other")
        if m.jnt_stiffness[j].any():
            raise UserError(f"joint {names[j]!r} has a spring, which is not simulated; remove its stiffness")
        return j

    def _closed(self, j: int) -> float:
        """Where a joint is closed: at 0, or at the limit nearest to it."""
        low, high = self.model.jnt_range[j].tolist()
        return min(max(0.0, low), high) if self.model.jnt_limited[j] else 0.0

    def _travel(self) -> tuple[float, float]:
        """Sign and length of the way to the limit that is farther from closed."""
        low, high = self.model.jnt_range[self.joint].tolist()
        closed = self._closed(self.joint)
        return (1.0, high - closed) if high - closed >= closed - low else (-1.0, closed - low)

    def _inertia(self) -> tuple[float, np.ndarray, np.ndarray]:
        """Mass, centre of mass, and inertia about it, of all that moves."""
        m, d = self.model, self.data
        bodies = [b for b in range(m.nbody) if self.moves[b] and m.body_mass[b] > 0]
        mass = float(sum(m.body_mass[b] for b in bodies))
        if not bodies or not math.isfinite(mass):
            raise UserError(f"what joint {m.joint(self.joint).name!r} moves has no mass; give it an inertial")
        center = sum((m.body_mass[b] * d.xipos[b] for b in bodies), np.zeros(3)) / mass
        total = np.zeros((3, 3))
        for b in bodies:
            turn, away = d.ximat[b].reshape(3, 3), d.xipos[b] - center
            total += turn @ np.diag(m.body_inertia[b]) @ turn.T
            total += m.body_mass[b] * (away @ away * np.eye(3) - np.outer(away, away))  # Steiner
        if not np.isfinite(total).all() or np.linalg.eigvalsh(total)[0] <= 0:
            raise UserError(f"what joint {m.joint(self.joint).name!r} moves has an inertia that no body has")
        return mass, center, total

    # -- the handle -----------------------------------------------------------------------------------------

    def _handle(
        self, handle: str | Point, moving: list[int], corners: dict[int, np.ndarray]
    ) -> tuple[np.ndarray, tuple[float, float]]:
        """Its place, its thickness and the hand's angle around it; of a point those of the geometry nearest to it."""
        m, d = self.model, self.data
        if isinstance(handle, str):
            bodies = {m.body(b).name: b for b in range(1, m.nbody) if self.moves[b]}
            sites = {m.site(k).name: k for k in range(m.nsite) if self.moves[m.site_bodyid[k]]}
            geoms = {m.geom(g).name: g for g in moving}
            held = [g for g in moving if handle in bodies and m.geom_bodyid[g] == bodies[handle]]
            if held or handle in geoms:
                held = [max(held, key=lambda g: _box(corners[g])[1])] if held else [geoms[handle]]
                place = _box(corners[held[0]])[0]
            elif handle in bodies:
                place = d.xpos[bodies[handle]]
            elif handle in sites:
                place = d.site_xpos[sites[handle]]
            else:
                names = [name for name in (*bodies, *sites, *geoms) if name]
                raise UserError(f"handle={handle!r}: is nothing that moves; there are {', '.join(names)}")
        else:
            held, place = [], np.array(handle)
        near = held or [min(moving, key=lambda g: _distance(place, corners[g]))]
        x, y, _ = np.ptp(corners[near[0]], axis=0).tolist()
        # At angle 0 the fingers move along y.
        return place, (y, 0.0) if y <= x else (x, 0.5 * math.pi)

    # -- geometry -------------------------------------------------------------------------------------------

    def _corners(self, geom: int) -> np.ndarray:
        """Points (C, 3) around a geometry."""
        m, d = self.model, self.data
        shape = self._shape(geom)
        if shape == "mesh":
            local = _vertices(m, int(m.geom_dataid[geom]))
        else:
            a, b, c = m.geom_size[geom].tolist()
            half = {"box": (a, b, c), "sphere": (a, a, a), "cylinder": (a, a, b), "capsule": (a, a, a + b)}
            signs = np.array(np.meshgrid((-1, 1), (-1, 1), (-1, 1))).reshape(3, 8).T
            local = signs * half[shape]
        return d.geom_xpos[geom] + local @ d.geom_xmat[geom].reshape(3, 3).T

    def _shape(self, geom: int) -> str:
        known = {2: "sphere", 3: "capsule", 5: "cylinder", 6: "box", 7: "mesh"}
        kind = int(self.model.geom_type[geom])
        if kind not in known:
            name = self.model.geom(geom).name
            raise UserError(f"geom {name!r}: must be one of {', '.join(known.values())}; remove it")
        return known[kind]

    def _part(self, geom: int, touched: bool, seen: bool, point: Any, corners: np.ndarray) -> Part:
        m, d, s = self.model, self.data, self.scale
        shape = self._shape(geom)
        surface = hull = None
        if shape == "mesh":
            number = int(m.geom_dataid[geom])
            begin, count = m.mesh_faceadr[number], m.mesh_facenum[number]
            vertices = s * _vertices(m, number)
            surface = _surface(vertices, m.mesh_face[begin : begin + count])
            hull = _hull(m, number, vertices) if touched else None
        size = {"box": 3, "sphere": 1, "cylinder": 2, "capsule": 2, "mesh": 0}[shape]
        color = _color(m, geom)
        return Part(
            shape=shape,
            size=tuple(s * float(x) for x in m.geom_size[geom][:size]),
            place=point(d.geom_xpos[geom]),
            rotation=d.geom_xmat[geom].reshape(3, 3).copy(),
            color=None if color == UNSAID else (color[0], color[1], color[2]),
            touched=touched,
            seen=seen,
            surface=surface,
            hull=hull,
            corners=corners,
        )


def _compile(source: Source) -> mujoco.MjModel:
    import mujoco

    try:
        spec = mujoco.MjSpec.from_string(source.xml, assets=source.meshes)
        for mesh in spec.meshes:
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        return spec.compile()
    except Exception as error:  # MuJoCo's reader and compiler fail in ways of their own
        reason = " ".join(str(error).split()) or type(error).__name__
        raise UserError(f"MuJoCo cannot read it ({reason[:300]})") from error


def _color(m: mujoco.MjModel, geom: int) -> tuple[float, ...]:
    """Red, green, blue and opacity of a geometry: its own, else its material's."""
    color = tuple(float(c) for c in m.geom_rgba[geom])
    material = int(m.geom_matid[geom])
    if color == UNSAID and material >= 0:
        color = tuple(float(c) for c in m.mat_rgba[material])
    if not all(0 <= c <= 1 for c in color):
        raise UserError(
            f"geom {m.geom(geom).name!r} has a colour of {', '.join(f'{c:g}' for c in color)}: must be from 0 to 1"
        )
    return color


def _vertices(m: mujoco.MjModel, number: int) -> np.ndarray:
    begin = m.mesh_vertadr[number]
    return m.mesh_vert[begin : begin + m.mesh_vertnum[number]].astype(np.float64)


def _surface(vertices: np.ndarray, faces: np.ndarray) -> Surface:
    low, high = vertices.min(0), vertices.max(0)
    length, width, height = (high - low).tolist()
    return Surface(vertices, faces.astype(np.int64), (length, width, height), 0.5 * (low + high), 0.0)


def _hull(m: mujoco.MjModel, number: int, vertices: np.ndarray) -> Surface:
    """A mesh's convex hull as MuJoCo keeps it: counts, then first edges, numbers of vertices, edges, faces."""
    if m.mesh_graphadr[number] < 0:
        raise UserError(f"mesh {m.mesh(number).name!r} has no convex hull")
    graph = m.mesh_graph[m.mesh_graphadr[number] :]
    points, faces = int(graph[0]), int(graph[1])
    begin = 2 + 3 * points + 3 * faces
    used, corners = np.unique(graph[begin : begin + 3 * faces], return_inverse=True)
    return _surface(vertices[used], corners.reshape(-1, 3))


def _box(corners: np.ndarray) -> tuple[np.ndarray, float]:
    """Middle and volume of the box around some points."""
    low, high = corners.min(0), corners.max(0)
    return 0.5 * (low + high), float(np.prod(high - low))


def _distance(point: np.ndarray, corners: np.ndarray) -> tuple[float, float]:
    """Distance of a point from the box around some others, and that box's volume."""
    away = point - np.clip(point, corners.min(0), corners.max(0))
    return float(np.linalg.norm(away)), _box(corners)[1]
