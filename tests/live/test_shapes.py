"""The arm's triangles: where every viewer that draws for itself gets them."""

from __future__ import annotations

import numpy as np
import torch

from franka_wm.live.shapes import Shape, arm_shapes, wxyz


def rotate(q: np.ndarray, points: np.ndarray) -> np.ndarray:
    w, v = q[0], q[1:]
    return points + 2 * np.cross(v, np.cross(v, points) + w * points)


def corners(shapes: list[Shape], bodies: np.ndarray) -> np.ndarray:
    """All vertices in the world."""
    out = []
    for shape in shapes:
        points = rotate(shape.wxyz, shape.vertices) + shape.position
        if shape.body >= 0:
            pose = bodies[shape.body]
            points = rotate(wxyz(pose[3:]), points) + pose[:3]
        out.append(points)
    return np.concatenate(out)


def test_shapes_of_one_arm_without_ground_and_marker(small_env) -> None:
    plain = arm_shapes(small_env(3).model)
    marked = arm_shapes(small_env(1, show_goal=True).model)
    assert [s.name for s in plain] == [s.name for s in marked]
    assert {s.body for s in plain} == set(range(-1, 7)), "every link is drawn, and the base"
    for shape in plain:
        assert shape.faces.max() < len(shape.vertices)
        assert np.isfinite(shape.vertices).all()
        assert np.isclose(np.linalg.norm(shape.wxyz), 1.0)
    bright = [s for s in plain if min(s.colour) > 200]
    dark = [s for s in plain if max(s.colour) < 60]
    assert bright and dark, "white shells, dark joints"


def test_they_are_where_the_simulation_has_the_arm(small_env) -> None:
    """A vertex for every extreme: the base stands on the ground, the fingers end at the tool."""
    env = small_env(1)
    env.reset(seed=4)
    shapes = arm_shapes(env.model)
    bodies = env.simulation.tensors.body_q[0].numpy()
    points = corners(shapes, bodies)
    assert abs(points[:, 2].min()) < 1e-3
    tool = env.tool_position()[0].numpy()
    assert np.linalg.norm(points - tool, axis=1).min() < 0.03
    moved = torch.full((1, 7), 1.0)
    now = env.reset(seed=4)
    for _ in range(5):
        now = env.step_and_maybe_reset(now.set("action", moved))[1]
    after = corners(shapes, env.simulation.tensors.body_q[0].numpy())
    assert np.abs(after - points).max() > 0.05


def test_normals_point_outwards(small_env) -> None:
    for shape in arm_shapes(small_env(1).model):
        assert shape.normals is not None
        centre = shape.vertices.mean(0)
        outward = np.einsum("ij,ij->i", shape.normals, shape.vertices - centre)
        assert (outward > -1e-6).all()
        a, b, c = (shape.vertices[shape.faces[:, k]] for k in range(3))
        face = np.cross(b - a, c - a)
        size = np.linalg.norm(face, axis=1)
        assert (np.einsum("ij,ij->i", face, (a + b + c) / 3 - centre)[size > 1e-9] > -1e-9).all(), (
            "wound outwards"
        )
