"""Hollow objects: of a mesh with parts each is touched as its convex hull, not the hull of the whole."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.robots import meshes
from franka_wm.envs.scene import Body, Obstacle, Scene
from franka_wm.errors import UserError

INSIDE, OUTSIDE, HALF, BOTTOM, SIDES = 30.0, 36.0, 30.0, 6.0, 12  # of the cup [mm]
BALL = 0.015


def cup() -> trimesh.Trimesh:
    """Around the z axis, its middle at (100, 0, 0) mm: a file's own origin."""
    floor = BOTTOM - HALF
    around = [[0, -HALF], [OUTSIDE, -HALF], [OUTSIDE, HALF], [INSIDE, HALF], [INSIDE, floor], [0, floor]]
    out = trimesh.creation.revolve(np.array(around), sections=SIDES)
    out.merge_vertices()
    out.apply_translation((100, 0, 0))
    return out


def pieces() -> list[trimesh.Trimesh]:
    """A board of the wall for each side, and the bottom."""
    angles = np.linspace(0, 2 * np.pi, SIDES + 1)
    ends = np.stack([np.cos(angles), np.sin(angles)], 1)
    out = []
    for a, b in itertools.pairwise(ends):
        ring = [r * e for e in (a, b) for r in (INSIDE, OUTSIDE)]
        out.append(trimesh.convex.convex_hull(np.array([[*p, z] for p in ring for z in (-HALF, HALF)])))
    flat = [[*(INSIDE * e), z] for e in ends[:-1] for z in (-HALF, BOTTOM - HALF)]
    out.append(trimesh.convex.convex_hull(np.array(flat)))
    for part in out:
        part.apply_translation((100, 0, 0))
    return out


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("parts")
    cup().export(folder / "cup.obj")
    parts = pieces()
    trimesh.util.concatenate(parts).export(folder / "parts.obj")
    trimesh.util.concatenate(parts).export(folder / "parts.ply")
    trimesh.util.concatenate(parts).export(folder / "parts.stl")
    many = [
        trimesh.creation.box((1, 1, 1), trimesh.transformations.translation_matrix((100, 0, k / 3)))
        for k in range(65)
    ]
    trimesh.util.concatenate(many).export(folder / "many.obj")
    (folder / "flat.obj").write_text("v 100 0 0\nv 101 0 0\nv 100 1 0\nv 101 1 0\nf 1 2 3\nf 2 4 3\n")
    trimesh.creation.box((40, 40, 40)).export(folder / "elsewhere.obj")
    (folder / "none.obj").write_text("v 0 0 0\n")
    return folder


def of(files: Path, **more: Any) -> dict[str, Any]:
    return {"name": "cup", "shape": "mesh", "file": str(files / "cup.obj"), "scale": 0.001} | more


def make(scene: Scene, num_envs: int = 2) -> FrankaEnv:
    config = FrankaConfig(
        task="lift",
        scene=scene,
        observations=("state", "objects"),
        substeps=4,
        gravity_compensation=True,
        episode_length=100,
    )
    return FrankaEnv(config, num_envs=num_envs, device="cpu", seed=1)


def fall(env: FrankaEnv, steps: int = 30) -> torch.Tensor:
    """A ball above (0.51, 0) falls; objects (N, K, 13) at the end."""
    action = torch.zeros(env.num_envs, 8)
    action[:, -1] = 1.0
    root = env.reset()
    env.simulation.tensors.rest_q[:, 2:5] = torch.tensor([0.51, 0.0, 0.09])
    for _ in range(steps):
        root = env.step(root.set("action", action))["next"]
    assert env.statistics()["overflow"] == 0
    return root["objects"].view(env.num_envs, -1, 13)


BESIDE = Body(name="ball", shape="sphere", size=(BALL,), mass=0.02, at=(0.5, 0.25))


@pytest.mark.parametrize("kind", ["obj", "ply"])
def test_a_ball_falls_into_a_cup(files: Path, kind: str) -> None:
    """Onto its bottom; without parts it stays on top."""
    into = Body(**of(files, parts=str(files / f"parts.{kind}"), mass=0.1, at=(0.5, 0.0)))
    seen = fall(make(Scene(objects=(BESIDE, into))))
    assert (seen[:, 0, 2] - (0.001 * BOTTOM + BALL)).abs().max() < 1e-3
    assert (seen[:, 1, :3] - torch.tensor([0.5, 0.0, 0.03])).abs().max() < 1e-3  # stands on the table
    assert seen[:, 1, 7:].abs().max() < 1e-2
    if kind == "obj":
        full = Body(**of(files, mass=0.1, at=(0.5, 0.0)))
        assert (fall(make(Scene(objects=(BESIDE, full))))[:, 0, 2] > 0.06).all()


def test_an_obstacle_is_hollow_too(files: Path) -> None:
    fixed = Obstacle(**of(files, parts=str(files / "parts.obj"), at=(0.5, 0.0, 0.2)))
    env = make(Scene(objects=(BESIDE,), obstacles=(fixed,)))
    root, action = env.reset(), torch.zeros(2, 8)
    env.simulation.tensors.rest_q[:, 2:5] = torch.tensor([0.51, 0.0, 0.26])
    for _ in range(30):
        root = env.step(root.set("action", action))["next"]
    assert (root["objects"][:, 2] - (0.17 + 0.001 * BOTTOM + BALL)).abs().max() < 1e-3


def test_it_is_as_heavy_as_without_parts(files: Path) -> None:
    """Mass, centre and inertia are those of the surface, however parts overlap."""
    found = []
    for parts in (None, str(files / "parts.obj")):
        model = make(Scene(objects=(Body(**of(files, parts=parts, mass=0.1)),)), 1).simulation.model
        body = model.body_label.index("cup")
        found.append(
            [getattr(model, name).numpy()[body] for name in ("body_mass", "body_com", "body_inertia")]
        )
    for whole, apart in zip(*found, strict=True):
        np.testing.assert_allclose(apart, whole, rtol=1e-6, atol=1e-9)


def test_there_is_room_for_the_contacts_of_each_part(files: Path) -> None:
    whole, apart = (
        Scene(objects=(Body(**of(files, parts=parts)),)).contacts("hand")
        for parts in (None, str(files / "parts.obj"))
    )
    assert whole[0] == apart[0] and apart[1] - whole[1] == 8 * (SIDES + 1)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"parts": 3}, "scene.cup.parts=3: must be the path of an OBJ or PLY file, or null"),
        ({"parts": "missing.obj"}, "missing.obj: no such file"),
        ({"parts": "parts.stl"}, "must be a file that ends in .obj, .ply"),
        ({"parts": "many.obj"}, "has 65 parts, it may have from 1 to 64"),
        ({"parts": "none.obj"}, "none.obj"),
        ({"parts": "flat.obj"}, "part 1 of 1 is flat"),
        ({"parts": "elsewhere.obj"}, "beyond the mesh; they must be in its place and units"),
        (
            {"shape": "box", "file": None, "scale": 1.0, "parts": "parts.obj"},
            "is for shape: mesh, this is a box",
        ),
    ],
)
def test_bad_parts_are_one_line(files: Path, changes: dict[str, Any], said: str) -> None:
    values = of(files, **changes)
    if isinstance(values["parts"], str):
        values["parts"] = str(files / values["parts"])
    with pytest.raises(UserError) as caught:
        Scene.of({"objects": [values]})
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_a_mesh_file_that_changed_is_read_again(tmp_path: Path) -> None:
    pytest.importorskip("trimesh", reason="needs pip install 'franka-wm[meshes]'")
    path, sizes = tmp_path / "part.obj", []
    for side in (1, 1, 20):
        path.write_text(f"v 0 0 0\nv {side} 0 0\nv 0 {side} 0\nf 1 2 3\n")
        sizes.append(meshes.read(path)[0])
    assert sizes[0].vertices.max() == 1 and sizes[2].vertices.max() == 20
