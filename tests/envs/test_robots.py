"""Every ``robot=``: where its URDF comes from, what is drawn of it, and that it is the arm of that URDF."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from importlib.util import find_spec
from pathlib import Path

import mujoco
import newton
import numpy as np
import pytest
import torch
from torchrl.envs.utils import check_env_specs

from franka_wm.commands import listing
from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.robots import SOURCES, Source, load_robot, meshes, sources
from franka_wm.errors import UserError


def has_panda() -> bool:
    try:
        SOURCES["panda_meshes"].find(FrankaConfig())
    except UserError:
        return False
    return bool(find_spec("trimesh") and find_spec("collada"))


needs_meshes = pytest.mark.skipif(not has_panda(), reason="needs pip install 'franka-wm[meshes]'")
FRANKA = Path(str(SOURCES["embedded"].find(FrankaConfig())))


def state_env(**changes) -> FrankaEnv:
    urdf_path = changes.pop("urdf_path", None)
    config = FrankaConfig(**({"observations": ("state",), "substeps": 2} | changes))
    return FrankaEnv(config, num_envs=2, device="cpu", urdf_path=urdf_path)


def one_line(error: Exception) -> str:
    assert "\n" not in str(error)
    return str(error)


def expected_tools(urdf: Path, tool: str, joints: torch.Tensor) -> np.ndarray:
    """Where MuJoCo puts the tool of that URDF, without its shapes."""
    root = ET.parse(urdf).getroot()
    for link in root.iter("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(shape)
    settings = ET.SubElement(ET.SubElement(root, "mujoco"), "compiler")
    settings.set("fusestatic", "false")
    settings.set("balanceinertia", "true")
    settings.set("boundmass", "1e-6")
    settings.set("boundinertia", "1e-9")
    model = mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))
    data = mujoco.MjData(model)
    names = [j.get("name") for j in root.findall("joint") if j.get("type") == "revolute"]
    addresses = [model.joint(name).qposadr[0] for name in names]
    out = []
    for q in joints.double().numpy():
        data.qpos[addresses] = q
        mujoco.mj_kinematics(model, data)
        out.append(data.body(tool).xpos.copy())
    return np.array(out)


def random_joints(robot, count: int = 50) -> torch.Tensor:
    share = torch.rand(count, 7, generator=torch.Generator().manual_seed(0))
    lower, upper = torch.from_numpy(robot.lower), torch.from_numpy(robot.upper)
    return lower + share * (upper - lower)


# -- the names -------------------------------------------------------------------------------------------


def test_the_command_line_lists_every_robot() -> None:
    assert set(listing.ROBOTS) == set(SOURCES)


def test_unknown_robot_names_the_known_ones() -> None:
    with pytest.raises(UserError, match="embedded, newton_asset, panda_meshes"):
        FrankaConfig(robot="ur5")


def test_urdf_needs_its_path() -> None:
    with pytest.raises(UserError, match="urdf_path"):
        load_robot(FrankaConfig(robot="urdf"))


# -- newton_asset ----------------------------------------------------------------------------------------


def test_asset_without_network(monkeypatch) -> None:
    def fail(name: str):
        raise RuntimeError(f"cannot reach github.com for {name}\nand more lines")

    monkeypatch.setattr(newton.utils, "download_asset", fail)
    with pytest.raises(UserError) as caught:
        load_robot(FrankaConfig(robot="newton_asset"))
    message = one_line(caught.value)
    for word in ("cannot reach github.com", "embedded", "panda_meshes", "urdf_path"):
        assert word in message


def test_asset_without_git_python(monkeypatch) -> None:
    def fail(name: str):
        raise ImportError("GitPython package is required")

    monkeypatch.setattr(newton.utils, "download_asset", fail)
    with pytest.raises(UserError, match=re.escape("pip install 'franka-wm[meshes]'")):
        load_robot(FrankaConfig(robot="newton_asset"))


def test_asset_that_was_downloaded(monkeypatch, tmp_path: Path) -> None:
    asked = []

    def download(name: str) -> Path:
        asked.append(name)
        return tmp_path

    config = FrankaConfig(robot="newton_asset", observations=("state",), substeps=2)
    monkeypatch.setattr(newton.utils, "download_asset", download)
    with pytest.raises(UserError, match="urdf_relative_path"):
        load_robot(config)
    target = tmp_path / config.urdf_relative_path
    target.parent.mkdir(parents=True)
    target.write_text(FRANKA.read_text())
    env = FrankaEnv(config, device="cpu")
    assert set(asked) == {config.asset_name}
    check_env_specs(env)


# -- meshes ----------------------------------------------------------------------------------------------


def test_where_mesh_names_lead(tmp_path: Path) -> None:
    urdf = tmp_path / "work" / "my_arm" / "urdf" / "arm.urdf"
    mesh = tmp_path / "work" / "my_arm" / "meshes" / "link 0.stl"
    for path in (urdf, mesh):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    names = (
        "../meshes/link 0.stl", str(mesh), mesh.as_uri(), "package://my_arm/meshes/link 0.stl",
        "package://other_name/meshes/link 0.stl", "model://my_arm/meshes/link 0.stl",
    )  # fmt: skip
    for name in names:
        assert meshes.resolve(name, urdf) == mesh.resolve(), name
    for name in ("gone.stl", "package://my_arm/gone.stl", "https://example.com/link0.stl", ""):
        with pytest.raises(UserError) as caught:
            meshes.resolve(name, urdf)
        assert "arm.urdf" in one_line(caught.value)


def test_missing_mesh_reader_names_the_extra(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setitem(__import__("sys").modules, "trimesh", None)
    with pytest.raises(UserError, match=re.escape("pip install 'franka-wm[meshes]'")):
        meshes.read(tmp_path / "link0.stl")


def test_missing_package_names_the_extra(monkeypatch) -> None:
    def missing(name: str):
        raise sources.PackageNotFoundError(name)

    monkeypatch.setattr(sources, "distribution", missing)
    with pytest.raises(UserError, match=re.escape("pip install 'franka-wm[meshes]'")):
        load_robot(FrankaConfig(robot="panda_meshes"))


@pytest.mark.parametrize("suffix", [".stl", ".dae", ".obj"])
def test_file_that_is_no_mesh(tmp_path: Path, suffix: str) -> None:
    pytest.importorskip("trimesh", reason="needs pip install 'franka-wm[meshes]'")
    pytest.importorskip("collada", reason="needs pip install 'franka-wm[meshes]'")
    path = tmp_path / f"bad{suffix}"
    path.write_text("not a mesh")
    with pytest.raises(UserError) as caught:
        meshes.read(path)
    assert path.name in one_line(caught.value)


def test_files_of_others_that_are_no_triangles_or_too_many(tmp_path: Path) -> None:
    pytest.importorskip("trimesh", reason="needs pip install 'franka-wm[meshes]'")
    archive, large = tmp_path / "a.zip", tmp_path / "large.stl"
    archive.write_bytes(b"PK")
    with large.open("wb") as file:
        file.truncate(meshes.MOST_BYTES + 1)  # takes no room
    for path, said in ((archive, "must be a file that ends in .dae, .obj"), (large, "larger than 64 MiB")):
        with pytest.raises(UserError) as caught:
            meshes.read(path)
        assert said in one_line(caught.value)


def test_a_texture_is_not_taken_from_elsewhere(tmp_path: Path) -> None:
    pytest.importorskip("trimesh", reason="needs pip install 'franka-wm[meshes]'")
    from PIL import Image

    folder = tmp_path / "robot"
    folder.mkdir()
    for place in (tmp_path / "secret.png", folder / "own.png"):
        Image.new("RGB", (2, 2), "red").save(place)
    (folder / "a.obj").write_text(
        "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3\n"
    )
    found = {}
    for name in ("own.png", "../secret.png", str(tmp_path / "secret.png")):
        (folder / "a.mtl").write_text(f"newmtl m\nmap_Kd {name}\n")
        meshes._read.cache_clear()
        found[name] = meshes.read(folder / "a.obj")[0].texture is not None
    assert list(found.values()) == [True, False, False], found


def grid(count: int) -> meshes.Piece:
    """A unit square of 2 · count² triangles that face +z."""
    x, y = np.meshgrid(np.linspace(0, 1, count + 1), np.linspace(0, 1, count + 1), indexing="ij")
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    k = (np.arange(count)[:, None] * (count + 1) + np.arange(count)).ravel()
    faces = np.concatenate(
        [np.stack([k, k + count + 1, k + 1], 1), np.stack([k + 1, k + count + 1, k + count + 2], 1)]
    )
    return meshes.Piece(vertices, np.tile([0.0, 0.0, 1.0], (len(vertices), 1)), faces, (1.0, 1.0, 1.0))


def test_thinning_keeps_the_surface() -> None:
    fine = grid(60)
    coarse = meshes.simplify(fine, 0.1)
    assert 2 * 9 * 9 <= len(coarse.faces) <= 2 * 11 * 11 < len(fine.faces)
    a, b, c = (coarse.vertices[coarse.faces[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    assert (across[:, 2] > 0).all()  # nothing turned over
    assert 0.8 < across[:, 2].sum() / 2 <= 1.0
    np.testing.assert_allclose(coarse.normals, np.tile([0, 0, 1.0], (len(coarse.vertices), 1)))
    assert meshes.simplify(fine, 0.0) is fine
    assert len(meshes.simplify(fine, 5.0).faces) == 0


def test_meshes_are_placed_scaled_and_coloured(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh", reason="needs pip install 'franka-wm[meshes]'")
    trimesh.creation.box((1, 2, 3)).export(tmp_path / "box.stl")
    root = ET.fromstring("""<robot name="r"><material name="red"><color rgba="1 0 0 1"/></material>
      <link name="a"><visual><origin xyz="0 0 5" rpy="0 0 1.5707963267948966"/>
        <geometry><mesh filename="box.stl" scale="1 1 -2"/></geometry><material name="red"/></visual></link></robot>""")
    (piece,) = meshes.take_visuals(root, tmp_path / "r.urdf")["a"]
    assert root.find(".//visual") is None
    assert piece.color == (1.0, 0.0, 0.0)
    np.testing.assert_allclose(piece.vertices.min(0), [-1, -0.5, 2], atol=1e-6)
    np.testing.assert_allclose(piece.vertices.max(0), [1, 0.5, 8], atol=1e-6)
    a, b, c = (piece.vertices[piece.faces[:, k]] for k in range(3))
    outward = np.einsum("ij,ij->i", np.cross(b - a, c - a), (a + b + c) / 3 - [0, 0, 5])
    assert (outward > 0).all()  # a mirrored mesh is not inside out
    assert (np.einsum("ij,ij->i", piece.normals, piece.vertices - [0, 0, 5]) > 0).all()


# -- the Panda -------------------------------------------------------------------------------------------


@needs_meshes
def test_panda_is_the_arm_of_its_urdf() -> None:
    config = FrankaConfig(robot="panda_meshes", observations=("state",), substeps=2)
    urdf = SOURCES["panda_meshes"].find(config)
    env = FrankaEnv(config, num_envs=2, device="cpu")
    limits = [j.find("limit") for j in ET.parse(urdf).getroot().iter("joint") if j.get("type") == "revolute"]
    robot = env.simulation.robot
    assert robot.joint_names == tuple(f"panda_joint{k}" for k in range(1, 8))
    for name, values in (("lower", robot.lower), ("upper", robot.upper), ("velocity", robot.velocity_limit)):
        np.testing.assert_allclose(values, [float(limit.get(name)) for limit in limits], rtol=1e-6)
    effort = [float(limit.get("effort")) for limit in limits]
    np.testing.assert_allclose(env.model.joint_effort_limit.numpy().reshape(2, 7)[1], effort)
    masses = [4.970684, 0.646926, 3.228604, 3.587895, 1.225946, 1.666555, 0.735522 + 0.73 + 2 * 0.015]
    np.testing.assert_allclose(env.model.body_mass.numpy().reshape(2, -1)[1], masses, rtol=1e-6)
    np.testing.assert_allclose(env.model.body_inertia.numpy()[0, 0, 0], 0.70337, rtol=1e-6)

    joints = random_joints(robot)
    tools = expected_tools(urdf, "panda_hand_tcp", joints)
    np.testing.assert_allclose(env.kinematics.forward(joints).numpy(), tools, atol=1e-5)


@needs_meshes
def test_panda_runs(random_actions) -> None:
    env = state_env(robot="panda_meshes", observations=("pixels", "state"), image_size=32)
    check_env_specs(env)
    played = env.rollout_actions(random_actions(2, 8), seed=1)
    torch.testing.assert_close(env.kinematics.forward(played["joint_q"]), played["tool"], atol=1e-5, rtol=0)
    first = env.reset()["pixels"].clone()
    assert not torch.equal(first[0], first[1])  # two poses


@needs_meshes
def test_panda_looks_like_one() -> None:
    """White shells and dark trims before the background, by the same numbers of pixels thinned out or not."""
    pictures = {}
    for robot in ("panda_meshes", "panda_meshes_full"):
        env = state_env(robot=robot, pose_noise=0.0)
        env.reset()
        pictures[robot] = env.render(128, num_views=1)[0].float()
    full = pictures["panda_meshes_full"]
    assert (full.min(-1).values > 200).sum() > 300  # white
    assert (full.max(-1).values < 75).sum() > 30  # dark
    assert (pictures["panda_meshes"] - full).abs().mean() < 3.0


@needs_meshes
def test_the_hand_is_seen_in_small_pictures() -> None:
    """What a model gets by default, 64 × 64: shapes as small as fingers are not thinned out like arms."""
    seen, triangles = {}, {}
    for robot in ("panda_meshes", "panda_meshes_full"):
        env = FrankaEnv(
            FrankaConfig(robot=robot, observations=("segmentation", "pixels")), num_envs=16, device="cpu"
        )
        seen[robot] = env.reset(seed=3)
        drawn = {id(s): s for s in env.model.shape_source if isinstance(s, newton.Mesh)}
        triangles[robot] = [len(mesh.indices) // 3 for mesh in drawn.values()]
    thin, full = seen["panda_meshes"], seen["panda_meshes_full"]
    hand = full["segmentation"] == full["segmentation"].max()
    assert (thin["segmentation"] != full["segmentation"])[hand].float().mean() < 0.12
    assert (thin["pixels"].float() - full["pixels"].float()).abs().mean() < 2.0
    assert sum(triangles["panda_meshes"]) < 3_000 and min(triangles["panda_meshes"][-2:]) >= 40  # the fingers
    assert len(triangles["panda_meshes"]) < len(triangles["panda_meshes_full"])  # screws are left out


@pytest.mark.parametrize(
    ("size", "kept"),
    [
        ((0.003, 0.003, 0.003), False),  # a screw
        ((0.02, 0.02, 0.02), False),  # less than half of 3 cm squared
        ((0.022, 0.022, 0.005), True),
        ((0.004, 0.004, 0.4), True),  # a rod is seen, thin as it is
    ],
)
def test_shapes_that_cover_less_than_a_pixel_are_left_out(size: tuple[float, ...], kept: bool) -> None:
    vertices = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * np.array(size)
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([corners for a, b, c, d in sides for corners in ((a, b, c), (a, c, d))])
    piece = meshes.Piece(
        vertices, vertices / np.linalg.norm(vertices - 0.1, axis=1, keepdims=True), faces, None
    )
    for cell, drawn in ((0.03, kept), (0.0, True)):
        builder = newton.ModelBuilder()
        meshes.draw(builder, builder.add_body(), [piece], cell)
        assert builder.shape_count == int(drawn), cell


@needs_meshes
def test_worlds_share_the_meshes_and_triangles_are_few() -> None:
    triangles = {}
    for robot in ("panda_meshes", "panda_meshes_full"):
        model = state_env(robot=robot).model
        sources_of = [s for s in model.shape_source if isinstance(s, newton.Mesh)]
        worlds = model.shape_world.numpy()
        per_world = [
            [id(s) for s, w in zip(model.shape_source, worlds, strict=True) if w == k and s is not None]
            for k in range(2)
        ]
        assert per_world[0] == per_world[1] and len(per_world[0]) < 30
        pointers = model.shape_source_ptr.numpy()
        assert set(pointers[worlds == 0]) == set(pointers[worlds == 1])  # on the device, too
        triangles[robot] = sum(len(s.indices) // 3 for s in sources_of) // 2
    assert triangles["panda_meshes"] < 30_000 < 100_000 < triangles["panda_meshes_full"]


# -- one's own -------------------------------------------------------------------------------------------


def examples() -> list[str]:
    text = (Path(__file__).resolve().parents[2] / "docs" / "robots.md").read_text(encoding="utf-8")
    return re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)


def test_the_documented_example(monkeypatch, tmp_path: Path) -> None:
    """Runs ``docs/robots.md``: seven joints drawn differently, from a URDF string."""
    monkeypatch.chdir(tmp_path)
    before = dict(SOURCES)
    scope: dict = {}
    try:
        for example in examples():
            exec(compile(example, "docs/robots.md", "exec"), scope)
        env, urdf = scope["env"], SOURCES["stick"].find(FrankaConfig())
        joints = random_joints(env.simulation.robot)
        np.testing.assert_allclose(
            env.kinematics.forward(joints).numpy(), expected_tools(urdf, "tool0", joints), atol=1e-5
        )
        check_env_specs(env)
        env.reset()
        orange = env.render(64)[0].float()
        assert ((orange[..., 0] > 150) & (orange[..., 2] < 90)).sum() > 10
    finally:
        SOURCES.clear()
        SOURCES.update(before)


def test_a_registered_robot_is_accepted_by_name(monkeypatch) -> None:
    monkeypatch.setitem(SOURCES, "mine", Source(lambda config: FRANKA))
    assert load_robot(FrankaConfig(robot="mine")).joint_names[0] == "fr3_joint1"


def test_colliders_are_drawn_where_there_is_nothing_else(tmp_path: Path) -> None:
    root = ET.parse(FRANKA).getroot()
    for visual in root.iter("visual"):
        visual.tag = "collision"
    path = tmp_path / "bare.urdf"
    ET.ElementTree(root).write(path)
    env = state_env(robot="urdf", urdf_path=path)
    same = state_env()
    assert env.model.shape_count == same.model.shape_count
    np.testing.assert_array_equal(env.model.body_mass.numpy(), same.model.body_mass.numpy())


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, 0.03),  # a pixel and a half of 64 is a little larger
        ({"image_size": 128}, 0.0158),
        ({"image_size": 128, "camera_fov_degrees": 30.0}, 0.00735),
        ({"cameras": ("front", "wrist")}, 0.008),
        ({"observations": ("state",)}, 0.008),
        ({"mesh_detail": 0.03}, 0.03),
        ({"mesh_detail": 0.0}, 0.0),
    ],
)
def test_meshes_are_as_fine_as_the_pictures(options: dict, expected: float) -> None:
    config = FrankaConfig(robot="panda_meshes", **options)
    assert sources.detail(SOURCES["panda_meshes"], config) == pytest.approx(expected, rel=0.02)
    assert sources.detail(SOURCES["panda_meshes_full"], config) == 0.0


def test_thinning_does_not_shrink(monkeypatch) -> None:
    """A ball loses far less of its volume than where vertices are put in the middle of their cubes."""
    trimesh = pytest.importorskip("trimesh")
    ball = trimesh.creation.icosphere(subdivisions=5)
    piece = meshes.Piece(np.array(ball.vertices), np.array(ball.vertex_normals), np.array(ball.faces), None)

    def lost() -> float:
        thin = meshes.simplify(piece, 0.3)
        assert len(thin.faces) < len(piece.faces) / 20
        return 1 - abs(trimesh.Trimesh(thin.vertices, thin.faces, process=False).volume) / ball.volume

    found = lost()
    monkeypatch.setattr(meshes, "_meet", lambda piece, place, cell: meshes._mean(piece.vertices, place))
    assert abs(found) < 0.5 * lost()


def test_bad_mesh_detail() -> None:
    for value in (-0.01, 0.2, "fine"):
        with pytest.raises(UserError, match="mesh_detail"):
            FrankaConfig(mesh_detail=value)
