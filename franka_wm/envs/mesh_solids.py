"""Solids from a file of triangles: read, refused in one line where they are no solid, and measured."""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from franka_wm.errors import UserError

INSTALL = "pip install 'franka-wm[meshes]'"
FORMATS = ("obj", "stl", "ply")
PARTS_FORMATS = ("obj", "ply")
"""Formats of files with parts: an STL does not say which triangles belong together."""
MOST_BYTES = 64 * 2**20
"""Largest file that is read."""
MOST_FACES = 50_000
"""Most triangles."""
MOST_PARTS = 64
"""Most parts that are touched in place of one hull: each costs time in every step."""
MOST_CORNERS = 256
"""Most corners of the convex hull that is touched: of a ball of 4 cm it is off by 0.1 mm, with 64 by a millimetre."""
LEAST_FILLED = 1e-4
"""Least part of the box around it that a solid fills."""


@dataclass(frozen=True, eq=False)
class Surface:
    """A closed surface around the middle of its bounding box; its sides are along the file's axes.

    Attributes:
        vertices: (V, 3) [m], each place once.
        faces: (F, 3) int, counterclockwise from outside.
        size: Length, width, height of the box around it [m].
        middle: Where the middle of that box is in the file, (3,) [m].
        volume: [m³].
    """

    vertices: np.ndarray
    faces: np.ndarray
    size: tuple[float, float, float]
    middle: np.ndarray
    volume: float

    def flat(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertices (3 F, 3), their normals, and faces (F, 3): each triangle for itself, so that edges look sharp."""
        corners = self.vertices[self.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-18)
        return corners.reshape(-1, 3), normals.repeat(3, axis=0), np.arange(3 * len(corners)).reshape(-1, 3)


def read_surface(file: str, scale: tuple[float, float, float]) -> Surface:
    """The surface in an OBJ, STL or PLY file, times ``scale`` along x, y and z; kept in memory.

    Materials and textures are not read.

    Raises:
        UserError: The file is missing, too large, of another format, or not one closed surface around a volume.
    """
    return _named(_read, _find(file, FORMATS), scale)


def read_parts(file: str, scale: tuple[float, float, float], surface: Surface) -> tuple[np.ndarray, ...]:
    """Corners (V, 3) [m] of each connected part of an OBJ or PLY file, around the middle of ``surface``.

    Parts are apart where they share no vertex of the file, though places may be the same.

    Raises:
        UserError: The file is missing, too large, of another format, has too many parts or a flat one, or reaches
            beyond the surface by a tenth of its longest side.
    """
    path = _find(file, PARTS_FORMATS)
    parts = [corners - surface.middle for corners in _named(_read_parts, path, scale)]
    beyond = max(float((np.abs(corners) - 0.5 * np.array(surface.size)).max()) for corners in parts)
    if beyond > 0.1 * max(surface.size):
        raise UserError(
            f"{path}: its parts reach {beyond:.3g} m beyond the mesh; they must be in its place and units"
        )
    return tuple(parts)


def _find(file: str, formats: tuple[str, ...]) -> Path:
    path = Path(file).expanduser()
    if path.suffix.lower().lstrip(".") not in formats:
        raise UserError(f"{file!r}: must be a file that ends in {', '.join(f'.{f}' for f in formats)}")
    if not os.path.isfile(path):  # unlike Path.is_file, it takes names that no file can have
        raise UserError(f"{path}: no such file")
    if path.stat().st_size > MOST_BYTES:
        raise UserError(f"{path}: larger than {MOST_BYTES / 2**20:g} MiB, the most that a mesh may have")
    return path


def _named[T](read: Callable[..., T], path: Path, scale: tuple[float, float, float]) -> T:
    """What ``read`` finds in a file as it is now; errors begin with its name."""
    stat = path.stat()
    try:
        return read(path, scale, stat.st_mtime_ns, stat.st_size)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error


@lru_cache(maxsize=64)
def _read_parts(path: Path, scale: tuple[float, float, float], _changed: int, _size: int) -> list[np.ndarray]:
    corners, faces = _checked(path, scale)
    count = len(corners)
    edges = (np.ones(2 * len(faces)), (np.tile(faces[:, 0], 2), faces[:, 1:].T.reshape(-1)))
    _, part_of = connected_components(coo_array(edges, shape=(count, count)), directed=False)
    used = np.unique(faces)
    parts = [corners[used[part_of[used] == k]] for k in np.unique(part_of[used])]
    if not 1 <= len(parts) <= MOST_PARTS:
        raise UserError(
            f"has {len(parts)} parts, it may have from 1 to {MOST_PARTS}; ask for fewer, or join some"
        )
    for k, part in enumerate(parts):
        sides = np.linalg.svd(part - part.mean(0), compute_uv=False) if len(part) >= 4 else np.zeros(3)
        if sides[2] <= 1e-4 * sides[0]:
            raise UserError(f"part {k + 1} of {len(parts)} is flat; leave it out")
    return parts


def _checked(path: Path, scale: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) [m] and faces (F, 3) of a file; those vertices that no face has may be anything."""
    vertices, faces = _triangles(path)
    if len(faces) > MOST_FACES:
        raise UserError(f"has {len(faces)} triangles, the most is {MOST_FACES}; thin it out")
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise UserError("names vertices that it does not have")
    if not np.isfinite(vertices[faces.reshape(-1)]).all():
        raise UserError("has vertices that are not finite")
    return vertices * np.array(scale), faces


@lru_cache(maxsize=64)
def _read(path: Path, scale: tuple[float, float, float], _changed: int, _size: int) -> Surface:
    vertices, faces = _checked(path, scale)
    vertices, faces = np.unique(vertices[faces.reshape(-1)], axis=0, return_inverse=True)
    faces = faces.reshape(-1, 3)
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    if len(faces) < 4:
        raise UserError(f"has {len(faces)} triangles; a solid has at least 4")
    _check_closed(faces)
    low, high = vertices.min(0), vertices.max(0)
    middle = 0.5 * (low + high)
    vertices = vertices - middle
    corners = vertices[faces]
    volume = float(np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0)
    if abs(volume) <= LEAST_FILLED * float(np.prod(high - low)):
        raise UserError("encloses no volume")
    if volume < 0:  # its triangles are all seen from inside
        faces = faces[:, ::-1]
    length, width, height = (high - low).tolist()
    return Surface(vertices, np.ascontiguousarray(faces), (length, width, height), middle, abs(volume))


def _triangles(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and faces (F, 3) as the file has them."""
    try:
        import trimesh
    except ImportError as error:
        raise UserError(f"reading meshes needs {error.name}; {INSTALL}") from error
    kind = path.suffix.lower().lstrip(".")
    more: dict[str, Any] = {"skip_materials": True} if kind != "stl" else {}
    try:
        # From memory: such a file names no other one that would be read.
        mesh = trimesh.load_mesh(io.BytesIO(path.read_bytes()), file_type=kind, process=False, **more)
        return np.array(mesh.vertices, dtype=np.float64).reshape(-1, 3), np.array(mesh.faces).reshape(-1, 3)
    except Exception as error:  # trimesh's readers fail in ways of their own
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise UserError(f"not a readable mesh ({reason})") from error


def _check_closed(faces: np.ndarray) -> None:
    """Each edge belongs to two triangles, which pass it in opposite directions."""
    start, end = faces.reshape(-1), np.roll(faces, -1, axis=1).reshape(-1)
    count = int(faces.max()) + 1
    there, back = start * count + end, end * count + start
    open_edges = len(np.setdiff1d(there, back, assume_unique=False))
    if open_edges:
        raise UserError(f"is not closed: {open_edges} edges belong to one triangle; fill its holes")
    if len(np.unique(there)) != len(there):
        raise UserError("has edges that more than two triangles share, or triangles that face different ways")
