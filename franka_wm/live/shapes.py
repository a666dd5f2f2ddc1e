"""What the arm looks like, as triangles: for every viewer that draws for itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import newton
import numpy as np
import warp as wp

from franka_wm.envs.camera import GOAL_MARKER

CREATE = {
    newton.GeoType.BOX: lambda x, y, z: newton.Mesh.create_box(x, y, z, compute_inertia=False),
    newton.GeoType.SPHERE: lambda r, *_: newton.Mesh.create_sphere(r, compute_inertia=False),
    newton.GeoType.CAPSULE: lambda r, h, _: newton.Mesh.create_capsule(
        r, h, up_axis=newton.Axis.Z, compute_inertia=False
    ),
    newton.GeoType.CYLINDER: lambda r, h, _: newton.Mesh.create_cylinder(
        r, h, up_axis=newton.Axis.Z, compute_inertia=False
    ),
    newton.GeoType.CONE: lambda r, h, _: newton.Mesh.create_cone(
        r, h, up_axis=newton.Axis.Z, compute_inertia=False
    ),
    newton.GeoType.ELLIPSOID: lambda x, y, z: newton.Mesh.create_ellipsoid(x, y, z, compute_inertia=False),
}


@dataclass(frozen=True)
class Shape:
    """One visible shape of the arm.

    Attributes:
        name: Unique among the shapes.
        body: Which moving link carries it, as a row of `FrankaEnv`'s body poses; −1: it stands still.
        position: In that link's frame, (3,) [m].
        wxyz: Its orientation there, (4,) unit quaternion, real part first.
        vertices: (V, 3) [m].
        faces: (F, 3) indices of vertices.
        normals: (V, 3), or None where the mesh has none.
        colour: RGB, 0 … 255.
    """

    name: str
    body: int
    position: np.ndarray
    wxyz: np.ndarray
    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None
    colour: tuple[int, int, int]


def wxyz(xyzw: np.ndarray) -> np.ndarray:
    """Quaternions (..., 4) with the real part first, from Newton's, which have it last."""
    return np.roll(xyzw, 1, axis=-1)


def arm_shapes(model: newton.Model) -> list[Shape]:
    """The visible shapes of the first world's arm; neither the ground nor the goal's marker.

    Textures are left out: a mesh has its shape's one colour.
    """
    bodies, worlds, flags = _host(model.shape_body), _host(model.shape_world), _host(model.shape_flags)
    types, scales = _host(model.shape_type), _host(model.shape_scale)
    poses, colours = _host(model.shape_transform), _host(model.shape_color)
    out = []
    for i, label in enumerate(model.shape_label):
        visible = flags[i] & int(newton.ShapeFlags.VISIBLE)
        if worlds[i] != 0 or not visible or label.endswith(GOAL_MARKER):
            continue
        mesh = _mesh(newton.GeoType(int(types[i])), scales[i], model.shape_source[i])
        if mesh is None:
            continue
        vertices, faces, normals = mesh
        red, green, blue = (round(255 * float(c)) for c in np.clip(colours[i], 0.0, 1.0))
        out.append(
            Shape(
                name=f"{i:03d}",
                body=int(bodies[i]),
                position=poses[i, :3].astype(np.float64),
                wxyz=wxyz(poses[i, 3:]).astype(np.float64),
                vertices=vertices,
                faces=faces,
                normals=normals,
                colour=(red, green, blue),
            )
        )
    return out


def _host(array: wp.array | None) -> np.ndarray:
    assert array is not None  # Newton's annotation: only an unfinished model has none
    return array.numpy()


def _mesh(
    kind: newton.GeoType, scale: np.ndarray, source: Any
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None] | None:
    """Vertices, faces and normals of a shape; None for planes and what has no surface."""
    if kind in CREATE:
        mesh, factor = CREATE[kind](*(float(s) for s in scale)), np.ones(3)
    elif isinstance(source, newton.Mesh):
        mesh, factor = source, np.asarray(scale, dtype=np.float64)
    else:
        return None
    vertices = (np.asarray(mesh.vertices) * factor).astype(np.float32)
    faces = np.asarray(mesh.indices, dtype=np.uint32).reshape(-1, 3)
    normals = None if mesh.normals is None else np.asarray(mesh.normals, dtype=np.float32)
    if normals is not None and not np.allclose(factor, factor[0]):
        normals = None  # an uneven scale would tilt them
    return vertices, faces, normals
