"""URDF and MJCF files of a scene that cannot be: each is refused in one line, before anything is built."""

from __future__ import annotations

from pathlib import Path

import pytest

import cabinets
from franka_wm.envs import FrankaConfig
from franka_wm.envs.scene import Articulated, ArticulatedFile, Scene
from franka_wm.errors import UserError

URDF, MJCF = cabinets.urdf(), cabinets.mjcf()
BOMB = '<!DOCTYPE robot [<!ENTITY a "aaaaaaaa"><!ENTITY b "&a;&a;&a;&a;">]>'
MESH = '<link name="m"><collision><geometry><mesh filename="{}"/></geometry></collision></link>'
MESH += '<joint name="m" type="fixed"><parent link="drawer"/><child link="m"/></joint>'
FREE = '<body name="ball"><freejoint/><geom size="0.1 0.1 0.1"/></body>'
BALL = '<body name="ball"><joint name="b" type="ball"/><geom size="0.1 0.1 0.1"/></body>'
SECOND = '<body name="flap"><joint name="flap" range="0 1"/><geom size="0.1 0.1 0.1"/></body>'


def asset(element: str) -> str:
    return MJCF.replace("<asset>", f"<asset>{element}")


def refused(path: Path, **changes) -> str:
    values = {"name": "cabinet", "file": str(path), "handle": "handle", "at": [0.82, 0.0]} | changes
    with pytest.raises(UserError) as caught:
        Scene.of({"articulated": [values], "table": {"size": [1.5, 1.4, 0.05], "at": [0.55, 0.0, 0.0]}})
    assert "\n" not in str(caught.value) and str(caught.value).startswith("scene")
    return str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("</robot>", "", "not readable XML"),
        ("<robot", BOMB + "<robot", "declares a document type"),
        ('<mass value="1.2"/>', '<mass value="nan"/>', "<mass value='nan'>: must be a number"),
        ('type="prismatic"', 'type="floating"', "of type 'floating': must be one of"),
        ('type="prismatic"', 'type="fixed"', "has no joint that moves"),
        ('<limit lower="0" upper="0.2" effort="10" velocity="1"/>', "", "has no limits"),
        ('<parent link="case"/>', '<parent link="handle"/>', "through a circle of joints"),
        ('lower="0"', 'lower="0.3"', "lies above upper"),
        ('upper="0.2"', 'upper="0.005"', "what moves opens by 0.005 m; must be from 0.01 to 2"),
        ('<mass value="1.2"/>', '<mass value="500"/>', "has a mass of 500.1 kg; must be from 0.01 to 50"),
        ('ixx="0.012"', 'ixx="0.9"', "MuJoCo cannot read it"),
        ('damping="2"', 'damping="1e6"', "has a damping of 1e+06"),
        ("</robot>", '<joint name="x" type="fixed"/></robot>', "its parent is None, which is no link"),
        ("<limit lower", '<mimic joint="screws"/><limit lower', "follows another one"),
        ("</robot>", MESH.format("../b.obj") + "</robot>", "lies outside of"),
        ("</robot>", MESH.format("link.obj") + "</robot>", "lies outside of"),
        ("</robot>", MESH.format("package:///etc/b.obj") + "</robot>", "no such file"),
        ("</robot>", MESH.format("http://a.b/c.obj") + "</robot>", "only local files are read"),
        ("</robot>", MESH.format("a.dae") + "</robot>", "must be a file that ends in .obj, .stl"),
        ("</robot>", MESH.format("torn.obj") + "</robot>", "MuJoCo cannot read it"),
        (
            "</robot>",
            MESH.format("polygon.obj") + "</robot>",
            "has a polygon of 1001 corners, the most is 1000",
        ),
        ("</robot>", MESH.format("many.obj") + "</robot>", "meshes with more than 600000 corners"),
        ("</robot>", MESH.format("many.stl") + "</robot>", "meshes with more than 600000 corners"),
        ("</robot>", "<a>" * 101 + "</a>" * 101 + "</robot>", "100 levels"),
        ("</robot>", "<a/>" * 20_001 + "</robot>", "more than 20000 elements"),
        ("</robot>", " " * 8 * 2**20 + "</robot>", "larger than 8 MiB"),
    ],
)
def test_urdf_that_cannot_be(old: str, new: str, said: str, tmp_path: Path) -> None:
    folder = tmp_path / "below"
    folder.mkdir()
    for place in (tmp_path / "b.obj", folder / "torn.obj"):
        place.write_text("v 0 0 0\nv 1 0 0\nf 1 2 3\n")
    (folder / "polygon.obj").write_text("f" + " 1" * 1001)
    (folder / "many.obj").write_text("v 0 0 0\r" * 600_001)  # a line's end, too
    (folder / "many.stl").write_bytes(bytes(80) + (100_001).to_bytes(4, "little"))
    (folder / "link.obj").symlink_to(tmp_path / "b.obj")
    assert old in URDF
    (folder / "a.urdf").write_text(URDF.replace(old, new, 1))
    assert said in refused(folder / "a.urdf")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (cabinets.mjcf(more="<actuator/>"), "<actuator> is not read"),
        (cabinets.mjcf(more='<include file="/etc/passwd"/>'), "<include> is not read"),
        (cabinets.mjcf(more="<equality/>"), "<equality> is not read"),
        (cabinets.mjcf(body='<include file="b.xml"/>'), "<body> with <include>"),
        (cabinets.mjcf(body=FREE), "<body> with <freejoint>"),
        (cabinets.mjcf(body=BALL), "joint 'b' neither slides nor turns"),
        (cabinets.mjcf(body=SECOND), "has 2 joints that move; say which one opens: joint: slide, flap"),
        (cabinets.mjcf(body='<geom type="ellipsoid" size="1 1 1"/>'), "must be one of sphere, capsule"),
        (cabinets.mjcf(body='<geom size="1 nan 1"/>'), "must be numbers from -1e+09 to 1e+09"),
        (cabinets.mjcf(body='<geom size="1 nan(1) 1"/>'), "must be numbers from -1e+09 to 1e+09"),
        (MJCF.replace('mass="1.2"', 'mass="-1"'), "<inertial mass='-1'>: must be numbers from 0 to"),
        (MJCF.replace('rgba="0.6', 'rgba="7.6'), "has a colour of 7.6, 0.4, 0.2, 1: must be from 0 to 1"),
        (asset('<mesh name="m" builtin="cone" params="100000000 1"/>'), "<mesh> with builtin="),
        (asset('<mesh name="m"><plugin plugin="x"/></mesh>'), "<mesh> with builtin="),
        (asset(f'<mesh name="m" vertex="{"0 " * 1_800_003}"/>'), "meshes with more than 600000 corners"),
        (cabinets.mjcf(body='<geom size="1e8 1 1"/>'), "reaches more than 10 m away"),
        (cabinets.mjcf(body='<geom size="0 0 0"/>'), "MuJoCo cannot read it"),
        (cabinets.mjcf(body='<geom size="1 1 1" material="gold"/>'), "MuJoCo cannot read it"),
        (cabinets.mjcf(body='<geom size=".1 .1 .1"/>' * 250), "has 259 geometries; the most is 256"),
        (MJCF.replace('damping="2"', 'stiffness="2"'), "has a spring"),
        (
            MJCF.replace("<asset>", '<asset><hfield name="h" nrow="9" ncol="9" size="1 1 1 1"/>'),
            "with <hfield>",
        ),
        ("<mujoco/>", "has no joint that moves"),
        ("<sdf/>", "URDF begins with <robot>, MJCF with <mujoco>"),
        ("", "not readable XML"),
    ],
)
def test_mjcf_that_cannot_be(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "a.xml").write_text(text)
    assert said in refused(tmp_path / "a.xml")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"handle": None}, "give the name of a link or site, or a point"),
        ({"handle": ""}, "give the name of a link or site, or a point"),
        ({"size": [1, 1, 1]}, "follows from the file; leave it out, give scale"),
        ({"size": 1}, "follows from the file; leave it out, give scale"),
        ({"parts": "b.obj"}, "follows from the file; leave it out"),
        ({"handle": "case"}, "is nothing that moves; there are drawer, handle"),
        ({"handle": [1.0]}, "give 3 numbers"),
        ({"joint": "hinge"}, "has no joint 'hinge' that moves; there are slide"),
        ({"joint": 3}, "must be the name of a joint"),
        ({"scale": [1, 1, 1]}, "must be one number from 0.001 to 1000"),
        ({"scale": 0.001}, "it must be from 0.01 to 5 m each: change scale"),
        ({"at": [1.2, 0.0]}, "the arm reaches"),
        ({"angle": 3.14}, "the arm reaches"),
        ({"spread": [0.0, -0.1]}, "must be at least 0"),
        ({"kind": "drawer"}, "unknown 'kind'"),
        ({"shape": "mesh"}, "follows from the file; leave it out"),
        ({"file": "nowhere.urdf"}, "no such file"),
        ({"file": "a.usd"}, "must be a file that ends in .urdf or .xml"),
        ({"file": 3}, "must be the path of a .urdf or .xml file"),
        ({"name": "table"}, "table is there 2 times"),
    ],
)
def test_fields_that_cannot_be(changes: dict, said: str, tmp_path: Path) -> None:
    (tmp_path / "a.urdf").write_text(URDF)
    assert said in refused(tmp_path / "a.urdf", **changes)


def test_drawers_of_numbers_and_of_files_are_told_apart(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="is an ArticulatedFile"):
        Articulated(name="chest", file="a.urdf")
    (tmp_path / "door.xml").write_text(MJCF.replace('type="slide" axis="-1 0 0"', 'axis="0 0 1"'))
    door = ArticulatedFile(name="door", file=str(tmp_path / "door.xml"), handle="handle", at=(0.65, 0.0))
    with pytest.raises(UserError, match="needs a drawer"):
        FrankaConfig(task="drawer", scene=Scene(articulated=(door,)))
