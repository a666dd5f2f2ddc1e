"""The embedded arm is the FR3: Newton's model holds the numbers of the URDF, kinematics agree with MuJoCo's."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from importlib.resources import files

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.config import HOME
from franka_wm.envs.kinematics import Kinematics
from franka_wm.envs.robots.description import read_description
from franka_wm.envs.robots.gripper import PAD, PAD_ALONG, PAD_AWAY
from franka_wm.errors import UserError


@pytest.fixture(scope="module")
def urdf() -> ET.Element:
    return ET.fromstring((files("franka_wm.envs.robots") / "fr3.urdf").read_text())


@pytest.fixture(scope="module")
def env(small_env) -> FrankaEnv:
    return small_env(2)


@pytest.fixture(scope="module")
def kinematics(env: FrankaEnv) -> Kinematics:
    return env.kinematics


def random_joints(kinematics: Kinematics, count: int, seed: int = 0) -> torch.Tensor:
    share = torch.rand(count, 7, generator=torch.Generator().manual_seed(seed))
    return kinematics.lower + share * (kinematics.upper - kinematics.lower)


def numbers(text: str) -> np.ndarray:
    return np.array([float(v) for v in text.split()])


def inertial(urdf: ET.Element, name: str) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, centre of mass, inertia about it, in the link's frame."""
    link = next(e for e in urdf.iter("link") if e.get("name") == name).find("inertial")
    i = {k: float(v) for k, v in link.find("inertia").attrib.items()}
    tensor = np.array(
        [
            [i["ixx"], i["ixy"], i["ixz"]],
            [i["ixy"], i["iyy"], i["iyz"]],
            [i["ixz"], i["iyz"], i["izz"]],
        ]
    )
    return float(link.find("mass").get("value")), numbers(link.find("origin").get("xyz")), tensor


def test_masses_and_inertias_of_the_links(env: FrankaEnv, urdf: ET.Element) -> None:
    labels = [label.rsplit("/", 1)[-1] for label in env.model.body_label]
    mass, com, inertia = (getattr(env.model, f"body_{name}").numpy() for name in ("mass", "com", "inertia"))
    for world in range(2):
        for k in range(1, 7):
            body = world * len(labels) // 2 + labels[: len(labels) // 2].index(f"fr3_link{k}")
            m, c, i = inertial(urdf, f"fr3_link{k}")
            np.testing.assert_allclose(mass[body], m, rtol=1e-6)
            np.testing.assert_allclose(com[body], c, atol=1e-7)
            np.testing.assert_allclose(inertia[body], i, atol=1e-7)


def test_the_last_link_carries_hand_and_fingers(env: FrankaEnv, urdf: ET.Element) -> None:
    """Newton merges what is fixed; here the same is done with the parallel-axis theorem."""
    turn = Rotation.from_euler("z", -np.pi / 4).as_matrix()
    flange = np.array([0, 0, 0.107])
    grip = np.array([0, 0, 0.0584])
    opening = np.array([0, env.config.finger_opening, 0])
    half = Rotation.from_euler("z", np.pi).as_matrix()
    parts = [
        (inertial(urdf, "fr3_link7"), np.eye(3), np.zeros(3)),
        (inertial(urdf, "fr3_hand"), turn, flange),
        (inertial(urdf, "fr3_leftfinger"), turn, flange + turn @ (grip + opening)),
        (inertial(urdf, "fr3_rightfinger"), turn @ half, flange + turn @ (grip - opening)),
    ]
    total = sum(p[0][0] for p in parts)
    centre = sum(m * (r @ c + t) for (m, c, _), r, t in parts) / total
    tensor = np.zeros((3, 3))
    for (m, c, i), r, t in parts:
        d = r @ c + t - centre
        tensor += r @ i @ r.T + m * (d @ d * np.eye(3) - np.outer(d, d))
    labels = [label.rsplit("/", 1)[-1] for label in env.model.body_label]
    body = next(k for k, label in enumerate(labels) if label.startswith("fr3_link7"))
    np.testing.assert_allclose(env.model.body_mass.numpy()[body], total, rtol=1e-5)
    np.testing.assert_allclose(env.model.body_com.numpy()[body], centre, atol=1e-6)
    np.testing.assert_allclose(env.model.body_inertia.numpy()[body], tensor, atol=1e-6)


def test_limits_and_servo(env: FrankaEnv, urdf: ET.Element) -> None:
    limits = [j.find("limit") for j in urdf.iter("joint") if j.get("type") == "revolute"]
    model, config = env.model, env.config
    for name, tensor in (("lower", env.kinematics.lower), ("upper", env.kinematics.upper)):
        expected = np.array([float(limit.get(name)) for limit in limits], dtype=np.float32)
        np.testing.assert_array_equal(tensor.numpy(), expected)
        np.testing.assert_array_equal(
            getattr(model, f"joint_limit_{name}").numpy().reshape(2, 7), np.stack([expected] * 2)
        )
    effort = [float(limit.get("effort")) for limit in limits]
    np.testing.assert_allclose(model.joint_effort_limit.numpy().reshape(2, 7)[1], effort)
    velocity = [float(limit.get("velocity")) for limit in limits]
    np.testing.assert_allclose(env.simulation.robot.velocity_limit, velocity, rtol=1e-6)
    assert (model.joint_target_ke.numpy() == config.target_ke).all()
    assert (model.joint_target_kd.numpy() == config.target_kd).all()
    np.testing.assert_allclose(model.joint_armature.numpy(), config.joint_armature)


def test_gains_per_joint(small_env) -> None:
    gains = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0)
    env = small_env(2, target_ke=gains)
    np.testing.assert_allclose(env.model.joint_target_ke.numpy().reshape(2, 7), [gains] * 2)


# -- kinematics ------------------------------------------------------------------------------------------


def plain_mujoco(urdf: ET.Element) -> mujoco.MjModel:
    """The same URDF in MuJoCo itself, without Newton."""
    robot = ET.fromstring(ET.tostring(urdf))
    for link in robot.iter("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
    settings = ET.SubElement(ET.SubElement(robot, "mujoco"), "compiler")
    settings.set("fusestatic", "false")
    return mujoco.MjModel.from_xml_string(ET.tostring(robot, encoding="unicode"))


def test_a_falling_arm_keeps_its_energy(small_env, urdf: ET.Element) -> None:
    """Without servos and friction: kinetic plus potential energy, as MuJoCo itself counts it, before limits are hit.

    0.27 s, in which it falls to 16 J. The integrator is of first order: half the step, half the error.
    """
    model = plain_mujoco(urdf)
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    joints = [model.joint(f"fr3_joint{k}") for k in range(1, 8)]
    at, moving = ([getattr(joint, name)[0] for joint in joints] for name in ("qposadr", "dofadr"))
    model.dof_armature[moving] = FrankaConfig().joint_armature
    data, worst = mujoco.MjData(model), []
    data.qpos[-2:] = FrankaConfig().finger_opening  # both fingers
    for substeps in (8, 16):
        env = small_env(
            1,
            substeps=substeps,
            target_ke=0.0,
            target_kd=0.0,
            pose_noise=0.0,
            gravity_compensation=False,
            episode_length=50,
        )
        states = env.rollout_actions(torch.zeros(1, 8, 7))["state"][0].double().numpy()
        energies = []
        for state in states:
            data.qpos[at], data.qvel[moving] = state[:7], state[7:14]
            mujoco.mj_forward(model, data)
            energies.append(data.energy.copy())
        potential, kinetic = np.array(energies).T
        assert kinetic[0] == 0.0 and kinetic[-1] > 10.0
        worst.append(np.abs(potential + kinetic - potential[0]).max() / kinetic[-1])
    assert worst[1] < 0.01, worst
    assert 0.4 < worst[1] / worst[0] < 0.6, worst


def test_forward_kinematics_agree_with_mujoco(kinematics: Kinematics, urdf: ET.Element) -> None:
    model = plain_mujoco(urdf)
    data = mujoco.MjData(model)
    joints = random_joints(kinematics, 100)
    addresses = [model.joint(f"fr3_joint{k}").qposadr[0] for k in range(1, 8)]
    expected = []
    for q in joints.double().numpy():
        data.qpos[addresses] = q
        mujoco.mj_kinematics(model, data)
        expected.append(data.body("fr3_hand_tcp").xpos.copy())
    np.testing.assert_allclose(kinematics.forward(joints).numpy(), expected, atol=1e-5)


def test_newton_puts_the_tool_where_the_kinematics_say(small_env, random_actions) -> None:
    env = small_env(4)
    played = env.rollout_actions(random_actions(4, 20), seed=3)
    torch.testing.assert_close(env.kinematics.forward(played["joint_q"]), played["tool"], atol=1e-5, rtol=0)


def test_jacobian_is_the_derivative(kinematics: Kinematics) -> None:
    joints = random_joints(kinematics, 8, seed=1)
    expected = torch.stack([torch.autograd.functional.jacobian(kinematics.forward, q) for q in joints])
    torch.testing.assert_close(kinematics.jacobian(joints), expected, atol=1e-5, rtol=0)


def test_inverse_kinematics_reaches_and_stays_in_the_limits(kinematics: Kinematics) -> None:
    near = torch.tensor(HOME) + 0.4 * torch.randn(200, 7, generator=torch.Generator().manual_seed(2))
    goals = kinematics.forward(near.clamp(kinematics.lower, kinematics.upper))
    solution = kinematics.solve(goals, torch.tensor(HOME).expand(200, 7), iterations=30)
    assert ((solution >= kinematics.lower) & (solution <= kinematics.upper)).all()
    miss = (kinematics.forward(solution) - goals).norm(dim=-1)
    assert (miss < 1e-3).float().mean() > 0.97, miss.sort().values[-8:]
    far = kinematics.solve(torch.tensor([5.0, 0.0, 0.0]), torch.tensor(HOME))
    assert torch.isfinite(far).all()
    assert ((far >= kinematics.lower) & (far <= kinematics.upper)).all()


def test_reachable(kinematics: Kinematics) -> None:
    assert kinematics.reachable((0.30, 0.15, 0.55))
    assert kinematics.reachable((-0.4, 0.3, 0.5))
    assert not kinematics.reachable((1.0, 0.0, 0.5))
    assert not kinematics.reachable((0.0, 0.0, 1.5))


# -- other robots ----------------------------------------------------------------------------------------


def test_urdf_of_ones_own(tmp_path, urdf: ET.Element) -> None:
    path = tmp_path / "mine.urdf"
    robot = ET.fromstring(ET.tostring(urdf))
    mass = next(e for e in robot.iter("link") if e.get("name") == "fr3_link3").find("inertial/mass")
    mass.set("value", "9.5")
    path.write_text(ET.tostring(robot, encoding="unicode"))
    env = FrankaEnv(FrankaConfig(robot="urdf", observations=("state",)), device="cpu", urdf_path=path)
    assert (np.abs(env.model.body_mass.numpy() - 9.5) < 1e-6).any()


BOMB = '<!DOCTYPE robot [<!ENTITY a "aaaaaaaa"><!ENTITY b "&a;&a;&a;&a;">]><robot name="&b;"/>'


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (BOMB, "declares a document type"),
        ("<robot>" + "<a>" * 200, "100 levels"),
        ("<robot>" + "<a/>" * 20_001 + "</robot>", "more than 20000 elements"),
    ],
)
def test_urdf_that_would_fill_the_memory(tmp_path, content: str, said: str) -> None:
    (tmp_path / "bad.urdf").write_text(content)
    with pytest.raises(UserError, match=said):
        read_description(tmp_path / "bad.urdf")


@pytest.mark.parametrize("content", ["not xml", "<robot name='r'><link name='base'/></robot>", None])
def test_urdf_that_cannot_be_used(tmp_path, content: str | None) -> None:
    path = tmp_path / "bad.urdf"
    if content is not None:
        path.write_text(content)
    with pytest.raises(UserError) as caught:
        FrankaEnv(FrankaConfig(robot="urdf", observations=("state",)), device="cpu", urdf_path=path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("finger", ["fr3_leftfinger", "fr3_rightfinger"])
def test_fingers_are_drawn_where_they_touch(finger: str, urdf: ET.Element) -> None:
    """A white finger and a dark pad, in the box that is felt; the pad's face is the box's."""
    link = next(e for e in urdf.iter("link") if e.get("name") == finger)
    felt = np.array(
        [[-PAD[0], PAD_AWAY - PAD[1], PAD_ALONG - PAD[2]], [PAD[0], PAD_AWAY + PAD[1], PAD_ALONG + PAD[2]]]
    )
    faces = {}
    for visual in link.findall("visual"):
        centre, sides = (
            numbers(visual.find("origin").get("xyz")),
            numbers(visual.find("geometry/box").get("size")),
        )
        assert (centre - sides / 2 >= felt[0] - 1e-9).all() and (centre + sides / 2 <= felt[1] + 1e-9).all()
        faces[visual.find("material").get("name")] = centre[1] - sides[1] / 2
    assert set(faces) == {"white", "dark"}
    assert faces["dark"] == pytest.approx(felt[0, 1]) and faces["white"] > faces["dark"]
