"""Meshes of a robot: where a URDF's file names lead, and what is drawn of them.

An image of thousands of worlds pays for every shape and triangle, and CAD meshes have far more of both than
64 pixels show. So what one link draws in one colour becomes one shape, and its triangles are thinned out
(:func:`simplify`). Masses and kinematics never come from meshes that are only drawn.
"""

from __future__ import annotations

import os
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import newton
import numpy as np
import warp as wp

from franka_wm.envs.mesh_solids import INSTALL, MOST_BYTES
from franka_wm.errors import UserError

FORMATS = ("dae", "obj", "stl", "glb", "gltf", "ply")
"""Files of triangles. The reader takes archives and voxels, too, of which a few bytes can become gigabytes."""

Color = tuple[float, float, float]


@dataclass(frozen=True)
class Piece:
    """The triangles of one link that share a colour, in the link's frame."""

    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    color: Color | None
    uvs: np.ndarray | None = None
    texture: np.ndarray | None = None


def resolve(name: str, urdf: Path) -> Path:
    """The file that a mesh name in a URDF means; nothing is downloaded.

    Plain names are relative to the URDF. ``package://NAME/…`` (and ``model://``) is looked for around the URDF:
    in every folder above it that is called ``NAME``, that holds ``NAME``, or, where the package's folder has
    another name, that holds the rest of the path.

    Raises:
        UserError: If there is no such file.
    """
    scheme, _, rest = name.partition("://")
    if not rest:
        candidates = [urdf.parent / name.removeprefix("file:")]
    elif scheme == "file":
        candidates = [Path(unquote(urlsplit(name).path))]
    elif scheme in ("package", "model"):
        package, _, inner = rest.partition("/")
        above = urdf.resolve().parents
        candidates = [p / inner for p in above if p.name == package]
        candidates += [p / rest for p in above] + [p / inner for p in above]
    else:
        raise UserError(
            f"{urdf.name}: mesh {name!r}: only local files are read; download it and name the file"
        )
    for path in candidates:
        if os.path.isfile(path):  # unlike Path.is_file, it takes names that no file can have
            return path.resolve()
    hint = (
        f"; put the URDF inside its package {rest.partition('/')[0]!r}"
        if scheme in ("package", "model")
        else ""
    )
    raise UserError(f"{urdf.name}: mesh {name!r} does not exist{hint}")


def take_visuals(root: ET.Element, urdf: Path) -> dict[str, list[Piece]]:
    """Removes the visual meshes from a URDF and returns what to draw instead, by link.

    Raises:
        UserError: If a file is missing or cannot be read.
    """
    colors = {}
    for material in root.iter("material"):
        color = material.find("color")
        if color is not None:
            colors.setdefault(material.get("name"), _color(color.get("rgba", "").split()))
    drawn: dict[str, list[Piece]] = {}
    for link in root.iter("link"):
        pieces: list[Piece] = []
        for visual in link.findall("visual"):
            mesh = visual.find("geometry/mesh")
            if mesh is None:
                continue
            material = visual.find("material")
            color = None if material is None else material.find("color")
            override = _color(color.get("rgba", "").split()) if color is not None else None
            if override is None and material is not None:
                override = colors.get(material.get("name"))
            scale = np.array([float(v) for v in (mesh.get("scale") or "1 1 1").split()])
            rotation, shift = _origin(visual)
            for piece in read(resolve(mesh.get("filename", ""), urdf)):
                turn = rotation / scale  # normals go by the inverse transpose
                normals = piece.normals @ turn.T
                length = np.linalg.norm(normals, axis=1, keepdims=True)
                pieces.append(
                    Piece(
                        (piece.vertices * scale) @ rotation.T + shift,
                        normals / np.maximum(length, 1e-12),
                        piece.faces if scale.prod() > 0 else piece.faces[:, ::-1],
                        override or piece.color,
                        piece.uvs,
                        piece.texture,
                    )
                )
            link.remove(visual)
        if pieces:
            drawn[link.get("name", "")] = list(merge(pieces))
    return drawn


def draw(builder: newton.ModelBuilder, body: int, pieces: list[Piece], cell: float) -> None:
    """Adds shapes that are only seen: no collisions, no mass; nothing smaller than ``cell`` [m].

    Small shapes keep finer details, half of their middle side: fingers would shrink in cubes of their own size. Those
    that cover less than half of ``cell``², about a pixel, are left out: each shape costs time, however small.
    """
    config = newton.ModelBuilder.ShapeConfig(
        density=0.0, has_shape_collision=False, has_particle_collision=False
    )
    for piece in pieces:
        if piece.texture is None:
            _, middle, longest = np.sort(np.ptp(piece.vertices, axis=0))
            if middle * longest < 0.5 * cell**2:
                continue
            piece = simplify(piece, min(cell, 0.5 * float(middle)))
        if not len(piece.faces):
            continue
        mesh = newton.Mesh(
            piece.vertices,
            piece.faces.flatten(),
            normals=piece.normals,
            uvs=piece.uvs,
            texture=piece.texture,
            color=piece.color,
            compute_inertia=False,
        )
        builder.add_shape_mesh(body, mesh=mesh, cfg=config)


def read(path: Path) -> tuple[Piece, ...]:
    """A mesh file (DAE, OBJ, STL, GLB, …), cut into its materials; kept for the next environment until it changes.

    Raises:
        UserError: If the reader is not installed, or the file is no mesh, too large or of another format.
    """
    found = path.stat() if path.exists() else None
    return _read(path, found and (found.st_mtime_ns, found.st_size))


@lru_cache(maxsize=64)
def _read(path: Path, _written: tuple[int, int] | None) -> tuple[Piece, ...]:
    if path.suffix.lower().lstrip(".") not in FORMATS:
        raise UserError(f"{path}: must be a file that ends in {', '.join(f'.{one}' for one in FORMATS)}")
    try:
        import trimesh

        if path.suffix.lower() == ".dae":
            import collada  # noqa: F401  trimesh reads DAE through it, and returns nothing without it
    except ImportError as error:
        raise UserError(f"{path.name}: reading meshes needs {error.name}; {INSTALL}") from error
    if path.stat().st_size > MOST_BYTES:
        raise UserError(f"{path}: larger than {MOST_BYTES / 2**20:g} MiB, the most that a mesh may have")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # pycollada's, about NumPy
            scene: Any = trimesh.load_scene(path)
        meshes = scene.dump()
    except Exception as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise UserError(f"{path}: not a readable mesh ({reason})") from error
    pieces = tuple(_piece(mesh) for mesh in meshes if len(getattr(mesh, "faces", ())))
    if not pieces:
        raise UserError(f"{path}: has no triangles")
    return pieces


def merge(pieces: list[Piece]) -> Iterator[Piece]:
    """One piece per colour; pieces with a texture stay alone."""
    groups: dict[Color | None, list[Piece]] = {}
    for piece in pieces:
        if piece.texture is not None:
            yield piece
        else:
            groups.setdefault(piece.color and _rounded(piece.color), []).append(piece)
    for group in groups.values():
        first = np.cumsum([0] + [len(p.vertices) for p in group])
        yield Piece(
            np.concatenate([p.vertices for p in group]),
            np.concatenate([p.normals for p in group]),
            np.concatenate([p.faces + k for p, k in zip(group, first, strict=False)]),
            group[0].color,
        )


def simplify(piece: Piece, cell: float) -> Piece:
    """Fewer triangles: all vertices within a cube of side ``cell`` [m] become one; 0 leaves them as they are.

    The one lies where the planes of the triangles around it meet best, so that shapes do not shrink (quadric error
    of vertex clusters: Lindstrom, SIGGRAPH 2000). A piece that fits into one cube vanishes. Vertices of a cube that
    face different ways keep normals of their own, so that edges stay sharp.
    """
    if cell <= 0:
        return piece
    place = _number(np.floor(piece.vertices / cell).astype(np.int64))[1]
    axis = np.abs(piece.normals).argmax(1)
    side = 2 * axis + (np.take_along_axis(piece.normals, axis[:, None], 1)[:, 0] > 0)
    corners, corner = np.unique(place * 6 + side, return_inverse=True)
    vertices = _meet(piece, place, cell)[corners // 6]
    normals = _mean(piece.normals, corner)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)

    places = place[piece.faces]
    whole = (places[:, 0] != places[:, 1]) & (places[:, 1] != places[:, 2]) & (places[:, 2] != places[:, 0])
    faces, places = corner[piece.faces[whole]], places[whole]
    start = places.argmin(1)  # the same triangle may start at any of its corners
    ordered = np.take_along_axis(places, (start[:, None] + np.arange(3)) % 3, 1)
    once = _number(ordered)[0] if len(ordered) else np.zeros(0, dtype=np.int64)
    used, faces = np.unique(faces[np.sort(once)], return_inverse=True)
    return Piece(vertices[used], normals[used], faces.reshape(-1, 3), piece.color)


def _meet(piece: Piece, place: np.ndarray, cell: float) -> np.ndarray:
    """For each cube the point of least squared distance to the planes of its triangles, weighted by their areas.

    Args:
        place: Number of each vertex's cube.
        cell: Side of a cube [m]; the point stays within half of that from the mean of the cube's vertices.
    """
    middle = _mean(piece.vertices, place)
    corners = piece.vertices[piece.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1, keepdims=True)
    unit = normal / np.maximum(area, 1e-18)
    matrix, offset = np.zeros((len(middle), 3, 3)), np.zeros((len(middle), 3))
    for k in range(3):
        at = place[piece.faces[:, k]]
        away = (unit * (corners[:, 0] - middle[at])).sum(1, keepdims=True)
        np.add.at(matrix, at, area[:, :, None] * unit[:, :, None] * unit[:, None, :])
        np.add.at(offset, at, area * unit * away)
    strength, axes = np.linalg.eigh(matrix)
    # Along a plane or an edge nothing says where: there the mean stays.
    firm = strength > 0.05 * strength[:, -1:]
    along = (axes.transpose(0, 2, 1) @ offset[:, :, None])[..., 0]
    along = np.where(firm, along / np.where(firm & (strength > 0), strength, 1.0), 0.0)
    move = (axes @ along[:, :, None])[..., 0]
    return middle + np.clip(move, -0.5 * cell, 0.5 * cell)


def _piece(mesh: Any) -> Piece:
    material = getattr(mesh.visual, "material", None)
    image = getattr(material, "image", None)
    if image is None:
        image = getattr(material, "baseColorTexture", None)
    uvs = getattr(mesh.visual, "uv", None)
    texture = None if image is None or uvs is None else np.array(image.convert("RGBA"), dtype=np.uint8)
    color = None
    if texture is not None:
        color = (1.0, 1.0, 1.0)
    elif getattr(mesh.visual, "defined", False):
        rgba = material.main_color if material is not None else mesh.visual.main_color
        color = _color([float(v) / 255 for v in rgba])
    return Piece(
        np.array(mesh.vertices, dtype=np.float64),
        np.array(mesh.vertex_normals, dtype=np.float64),
        np.array(mesh.faces, dtype=np.int64),
        color,
        None if texture is None else np.array(uvs, dtype=np.float32),
        texture,
    )


def _origin(element: ET.Element) -> tuple[np.ndarray, np.ndarray]:
    origin = element.find("origin")
    xyz, rpy = ("0 0 0", "0 0 0") if origin is None else (origin.get("xyz"), origin.get("rpy"))
    turn = wp.quat_rpy(*(float(v) for v in (rpy or "0 0 0").split()))
    rotation = np.array(wp.quat_to_matrix(turn), dtype=np.float64).reshape(3, 3)
    return rotation, np.array([float(v) for v in (xyz or "0 0 0").split()])


def _color(values: list[Any]) -> Color | None:
    return (float(values[0]), float(values[1]), float(values[2])) if len(values) >= 3 else None


def _rounded(color: Color) -> Color:
    """Colours that look the same: CAD files have many a white."""
    r, g, b = (round(4 * c) / 4 for c in color)
    return r, g, b


def _number(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where each distinct row of integers is first, and which of them every row is."""
    low = rows.min(0)
    key = np.ravel_multi_index(
        tuple((rows - low).T), tuple(rows.max(0) - low + 1)
    )  # ten times np.unique(axis=0)
    _, first, which = np.unique(key, return_index=True, return_inverse=True)
    return first, which


def _mean(values: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """The mean of the rows of each group."""
    count = np.bincount(groups)
    return np.stack([np.bincount(groups, values[:, k]) / count for k in range(3)], axis=1)
