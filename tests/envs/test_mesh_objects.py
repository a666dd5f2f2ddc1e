"""Objects from a file of triangles: as heavy, as solid and as seen as what they show; files that are no solid."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.scene import Body, Obstacle, Scene
from franka_wm.errors import UserError
from franka_wm.evaluation.closed_loop import play_episodes
from franka_wm.policies.expert import ExpertPolicy
from presets import LIFT

DRAWN: dict[str, Any] = {"at": (0.5, 0.0), "spread": (0.10, 0.15), "turn": math.pi / 4}
LEGS = (0.06, 0.04, 0.03)


def wedge() -> trimesh.Trimesh:
    """A prism over a right triangle in x and z, its corner at (10, 20, 30) m: a file's own origin."""
    a, b, c = LEGS
    points = np.array([[0, 0, 0], [a, 0, 0], [0, 0, c], [0, b, 0], [a, b, 0], [0, b, c]]) + np.array(
        [10, 20, 30]
    )
    return trimesh.convex.convex_hull(points)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("meshes")
    cube = trimesh.creation.box((40, 40, 40))  # in millimetres
    for suffix in ("obj", "stl", "ply"):
        cube.export(folder / f"cube.{suffix}")
    wedge().export(folder / "wedge.obj")
    trimesh.creation.icosphere(subdivisions=3, radius=0.03).export(folder / "ball.ply")
    trimesh.creation.annulus(0.04, 0.07, 0.03).export(folder / "ring.stl")
    inside = cube.copy()
    inside.invert()
    inside.export(folder / "inside.obj")
    opened = cube.copy()
    opened.faces = opened.faces[:-1]
    opened.export(folder / "open.obj")
    flat = trimesh.Trimesh(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]
    )
    flat.export(folder / "flat.obj")
    sheet = trimesh.Trimesh([[0, 0, 0], [1, 0, 1], [0, 1, 0]], [[0, 1, 2], [0, 2, 1]])
    sheet.export(folder / "sheet.obj")
    nan = cube.export(file_type="obj").splitlines()
    nan[next(k for k, line in enumerate(nan) if line.startswith("v "))] = "v nan 0 0"
    (folder / "nan.obj").write_text("\n".join(nan))
    trimesh.creation.icosphere(subdivisions=6, radius=1.0).export(folder / "fine.stl")
    with (folder / "large.stl").open("wb") as file:
        file.truncate(65 * 2**20)
    (folder / "noise.ply").write_bytes(bytes(range(256)))
    (folder / "none.obj").write_text("v 0 0 0\n")
    (folder / "cube.glb").write_bytes(b"")
    return folder


def mesh(files: Path, file: str, *, scale: float = 0.001, **more: Any) -> Body:
    return Body(
        **({"name": "cube", "shape": "mesh", "file": str(files / file), "scale": scale} | DRAWN | more)
    )


def make(scene: Scene, num_envs: int = 2, *, seed: int = 1, **changes: Any) -> FrankaEnv:
    return FrankaEnv(
        FrankaConfig(**(LIFT | {"scene": scene} | changes)), num_envs=num_envs, device="cpu", seed=seed
    )


def rest(env: FrankaEnv, steps: int) -> torch.Tensor:
    """Objects (steps, N, …) while the arm stands still."""
    action = torch.zeros(env.num_envs, env.action_dim)
    action[:, -1] = 1.0
    root, seen = env.reset(), []
    for _ in range(steps):
        root = env.step(root.set("action", action))["next"]
        seen.append(root["objects"].clone())
    return torch.stack(seen)


# -- physics ----------------------------------------------------------------------------------------------------


def test_a_mesh_of_a_cube_is_the_cube(files: Path) -> None:
    """It falls, slides and lies as the box does, from each format and from inside out.

    Faster than 0.5 m/s it tips, and then 0.6 mm lie between them: other points of contact are found.
    """

    def play(body: Body) -> torch.Tensor:
        env = make(Scene(objects=(body,)), 3)
        observation, t = env.reset(), env.simulation.tensors
        t.rest_q[0, 4] = 0.10  # falls
        t.rest_qd[1, 3] = 0.5  # slides; the third one lies
        out, action = [], torch.zeros(3, 8)
        for _ in range(20):
            observation = env.step(observation.set("action", action))["next"]
            out.append(observation["objects"].clone())
        assert env.statistics()["overflow"] == 0
        return torch.stack(out, 1)

    box = play(Body(name="cube", **DRAWN))
    assert (box[1, -1, 1] - box[1, 0, 1]).abs() > 0.01  # it slid
    for name in ("cube.obj", "cube.stl", "cube.ply", "inside.obj"):
        played = play(mesh(files, name))
        assert (played[..., :7] - box[..., :7]).abs().max() < 1e-5, name
        assert (played[:, -1, 2] - 0.02).abs().max() < 1e-3 and played[:, -1, 7:].abs().max() < 1e-3, name


def test_mass_centre_and_inertia_are_the_mesh_s(files: Path) -> None:
    """A wedge, against a prism's formulas; its place is the middle of the box around it."""
    env = make(Scene(objects=(mesh(files, "wedge.obj", scale=1.0, mass=0.09),)), 2)
    model, (a, b, c), m = env.simulation.model, LEGS, 0.09
    body = model.body_label.index("cube")
    np.testing.assert_allclose(model.body_mass.numpy()[body], m, rtol=1e-4)
    np.testing.assert_allclose(model.body_com.numpy()[body], (-a / 6, 0.0, -c / 6), atol=1e-6)
    expected = m * np.array(
        [
            [b * b / 12 + c * c / 18, 0.0, a * c / 36],
            [0.0, (a * a + c * c) / 18, 0.0],
            [a * c / 36, 0.0, a * a / 18 + b * b / 12],
        ]
    )
    np.testing.assert_allclose(model.body_inertia.numpy()[body], expected, rtol=1e-3, atol=1e-9)
    solver = env.simulation.solver.mj_model
    np.testing.assert_allclose(solver.body_ipos[-1], (-a / 6, 0.0, -c / 6), atol=1e-6)
    np.testing.assert_allclose(np.sort(solver.body_inertia[-1]), np.linalg.eigvalsh(expected), rtol=1e-3)
    seen = rest(env, 20)
    assert (seen[..., 2] - 0.5 * c).abs().max() < 1e-3 and seen[-1, :, 7:].abs().max() < 1e-3


def test_what_turns_in_the_air_turns_around_its_centre_of_mass(files: Path) -> None:
    """What is observed is the velocity of the centre of mass: where it falls, it has no part of the spin."""
    env = make(Scene(objects=(mesh(files, "wedge.obj", scale=1.0),)), 1)
    observation, t = env.reset(), env.simulation.tensors
    t.rest_q[:, 4], t.rest_q[:, 5:] = 0.6, torch.tensor([0.0, 0.0, 0.0, 1.0])
    t.rest_qd[:, 5:] = torch.tensor([[0.0, 8.0, 0.0]])
    for _ in range(6):
        observation = env.step(observation.set("action", torch.zeros(1, 8)))["next"]
        assert observation["objects"][0, 7:9].abs().max() < 5e-3  # the middle would have 80 mm/s
    assert (observation["objects"][0, 9] + 9.81 * 0.2).abs() < 0.02


def test_the_expert_lifts_it(files: Path) -> None:
    """Each of 32 worlds; fingers press into it by less than 1 mm."""
    env = make(Scene(objects=(mesh(files, "cube.stl"),)), 32, episode_length=200)
    policy, observation = ExpertPolicy(env.simulation.task, env.kinematics, env.config), env.reset()
    for _ in range(60):
        observation = env.step(policy(observation))["next"]
    assert observation["success"].all()
    between = 0.5 * observation["state"][:, 20:22].sum(-1) + 0.001  # from the middle to a pad's face
    assert (0.02 - between).max() < 1e-3
    assert env.statistics()["overflow"] == 0


def test_a_wedge_is_lifted_too(files: Path) -> None:
    env = make(Scene(objects=(mesh(files, "wedge.obj", scale=1.0),)), 16)
    played = play_episodes(env, ExpertPolicy(env.simulation.task, env.kinematics, env.config), seed=1)
    assert played["success_once"].mean() > 0.8


def test_a_pile_has_room_for_its_contacts(files: Path) -> None:
    bodies = [
        mesh(files, "cube.stl", name=f"cube{k}", at=(0.5, 0.1 * k - 0.2), spread=(0, 0)) for k in range(5)
    ]
    env = make(Scene(objects=tuple(bodies)), 2, end_when_lost=False)
    observation, t = env.reset(), env.simulation.tensors
    for k in range(5):
        t.rest_q[:, 2 + 7 * k : 4 + 7 * k] = torch.tensor([0.5, 0.0])
        t.rest_q[:, 4 + 7 * k] = 0.02 + 0.0401 * k
    for _ in range(30):
        observation = env.step(observation.set("action", torch.zeros(2, 8)))["next"]
    heights = observation["objects"].view(2, 5, 13)[..., 2]
    assert (heights - torch.tensor([0.02 + 0.04 * k for k in range(5)])).abs().max() < 2e-3
    assert env.statistics()["overflow"] == 0


# -- worlds -----------------------------------------------------------------------------------------------------


def test_worlds_do_not_depend_on_their_number_and_go_in_and_out(files: Path) -> None:
    scene, actions = (
        Scene(objects=(mesh(files, "wedge.obj", scale=1.0),)),
        torch.sin(torch.arange(384.0)).view(8, 6, 8),
    )

    def play(env: FrankaEnv, root) -> list:
        out = []
        for k in range(6):
            step, root = env.step_and_maybe_reset(root.clone().set("action", actions[: env.num_envs, k]))
            out.append(step["next", "objects"].clone())
        return out

    runs = []
    for n in (1, 2, 8):
        env = make(scene, n, episode_length=4)
        runs.append(play(env, env.reset(seed=3)))
    for run in runs[:-1]:
        assert all(torch.equal(a, b[: len(a)]) for a, b in zip(run, runs[-1], strict=True))
    env = make(scene, 2, episode_length=4)
    root = env.reset(seed=3)
    saved = env.get_state()
    first = play(env, root)
    env.reset(seed=9)
    env.set_state(saved)
    assert all(torch.equal(a, b) for a, b in zip(first, play(env, root), strict=True))


# -- images -----------------------------------------------------------------------------------------------------

LOOK: dict[str, Any] = {
    "observations": ("pixels", "segmentation"),
    "image_size": 96,
    "camera_distance": 0.8,
    "camera_height": 0.3,
    "camera_fov_degrees": 40.0,
    "camera_target_distance": 0.5,
    "camera_target_height": 0.0,
}


def look(*bodies: Body, obstacles: tuple[Obstacle, ...] = ()) -> tuple[torch.Tensor, torch.Tensor]:
    """Pixels (96, 96, 3) and numbers (96, 96)."""
    seen = make(Scene(objects=bodies, obstacles=obstacles), 1, **LOOK).reset()
    return seen["pixels"][0].float(), seen["segmentation"][0, ..., 0]


def test_images_show_the_mesh(files: Path) -> None:
    """A cube as the box, a ball as the sphere, in their colour; of a ring the hole, which its hull has not."""
    where: dict[str, Any] = {"at": (0.5, 0.0), "spread": (0, 0), "turn": 0.0, "color": (0.1, 0.8, 0.1)}
    for name, body in (
        ("cube.stl", Body(name="cube", **where)),
        ("ball.ply", Body(name="cube", shape="sphere", size=(0.03,), **where)),
    ):
        scale = 0.001 if name == "cube.stl" else 1.0
        (pixels, numbers), (expected, truth) = look(mesh(files, name, scale=scale, **where)), look(body)
        there, right = numbers == 12, truth == 12
        assert right.sum() > 50
        assert (there & right).sum() / (there | right).sum() > 0.9, name
        assert (pixels - expected)[there & right].abs().mean() < 12, name
    ring = {"scale": 1.0, "at": (0.5, 0.0), "spread": (0, 0)}
    _, numbers = look(mesh(files, "ring.stl", **ring))
    rows, columns = torch.nonzero(numbers == 12, as_tuple=True)
    inside = numbers[rows.min() : rows.max() + 1, int(columns.float().mean())]
    assert (inside == 254).any()  # the table, in its middle
    _, numbers = look(
        Body(name="cube", at=(0.45, -0.3)),
        obstacles=(Obstacle(name="ring", shape="mesh", file=str(files / "ring.stl")),),
    )
    assert (numbers == 253).any()


# -- bad files --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"file": None}, "scene.cube.file=None: a mesh needs the path of an OBJ, STL or PLY file"),
        ({"file": "missing.stl"}, "missing.stl: no such file"),
        ({"file": "cube.glb"}, "must be a file that ends in .obj, .stl, .ply"),
        ({"file": "large.stl"}, "larger than 64 MiB"),
        ({"file": "fine.stl"}, "has 81920 triangles, the most is 50000"),
        ({"file": "open.obj"}, "is not closed: 3 edges belong to one triangle"),
        ({"file": "flat.obj"}, "encloses no volume"),
        ({"file": "sheet.obj"}, "has 2 triangles; a solid has at least 4"),
        ({"file": "nan.obj"}, "not finite"),
        ({"file": "noise.ply"}, "not a readable mesh"),
        ({"file": "none.obj"}, "none.obj"),
        ({"mass": 0.0}, "scene.cube.mass=0.0: must be from 0.001"),
        ({"scale": 1.0}, "its mesh is 40 × 40 × 40 m"),
        ({"scale": 0}, "scene.cube.scale=[0.0, 0.0, 0.0]: must be from 1e-6"),
        ({"scale": [1, 2]}, "scene.cube.scale=[1, 2]: give 3 numbers"),
        ({"size": (0.1, 0.1, 0.1)}, "scene.cube.size=[0.1, 0.1, 0.1]: follows from a mesh's file"),
        ({"shape": "box"}, "is for shape: mesh, this is a box"),
    ],
)
def test_a_bad_file_is_one_line(files: Path, changes: dict, said: str) -> None:
    values: dict[str, Any] = {"name": "cube", "shape": "mesh", "file": "cube.stl", "scale": 0.001} | changes
    if values["file"]:
        values["file"] = str(files / values["file"])
    with pytest.raises(UserError) as caught:
        Scene.of({"objects": [values]})
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_without_a_reader_it_says_what_to_install(files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(UserError, match=r"needs trimesh; pip install 'franka-wm\[meshes\]'"):
        mesh(files, "cube.obj", scale=0.00123)  # a scale that no other test has read
