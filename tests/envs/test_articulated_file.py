"""Bodies with a joint from URDF and MJCF files: what is read of them, how they move, what is seen."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

import cabinets
from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.scene import ArticulatedFile, Scene
from franka_wm.evaluation.closed_loop import play_episodes
from franka_wm.policies.expert import ExpertPolicy
from presets import GRIPPER

TABLE = {"size": [1.5, 1.4, 0.05], "at": [0.55, 0.0, 0.0]}
OBSERVED = ("state", "joint_target", "objects", "goal")
DOOR = """<mujoco><compiler angle="degree" autolimits="true"/><worldbody>
  <body name="frame"><geom type="box" size="0.1 0.15 0.1" pos="0 0 0.1"/>
    <body name="lid" pos="-0.1 0.15 0.1"><joint name="hinge" axis="0 0 1" range="-90 0" armature="0.01"/>
      <geom name="leaf" type="box" size="0.01 0.15 0.1" pos="-0.012 -0.15 0" mass="0.5"/>
      <geom name="knob" type="capsule" size="0.01 0.02" pos="-0.06 -0.27 0" mass="0.1" rgba="0 1 0 1"/></body>
  </body></worldbody></mujoco>"""


def written(folder: Path, text: str, name: str = "cabinet.urdf") -> str:
    (folder / name).write_text(text)
    return str(folder / name)


def body(file: str, **changes) -> ArticulatedFile:
    return ArticulatedFile(
        **({"name": "cabinet", "file": file, "at": (0.82, 0.0), "handle": "handle"} | changes)
    )


def config(one: ArticulatedFile, **changes) -> FrankaConfig:
    scene = Scene.of({"table": TABLE, "articulated": [one]})
    return FrankaConfig(**(GRIPPER | {"task": "drawer", "scene": scene} | changes))


def make(one: ArticulatedFile, num_envs: int = 2, **changes) -> FrankaEnv:
    return FrankaEnv(config(one, **changes), num_envs=num_envs, device="cpu", seed=1)


def idle(env: FrankaEnv, steps: int) -> torch.Tensor:
    """``objects`` after so many steps of an arm at rest."""
    env.simulation.tensors.action.zero_()
    for _ in range(steps):
        env.simulation.step(restart=False)
    return env.simulation.tensors.next_objects.clone()


# -- what is read -----------------------------------------------------------------------------------------------


def test_both_formats_say_the_same(tmp_path: Path) -> None:
    first, second = (
        body(written(tmp_path, text, name)).mechanism
        for text, name in ((cabinets.urdf(), "a.urdf"), (cabinets.mjcf(), "a.xml"))
    )
    for m in (first, second):
        assert m.slides and m.travel == pytest.approx(0.2) and m.axis == (-1.0, 0.0, 0.0)
        assert (m.friction, m.damping) == (1.0, 2.0) and m.mass == pytest.approx(1.3)
        assert m.size == pytest.approx((0.288, 0.34, 0.22))
        # The case's middle is 6 mm behind its link's origin: the front is no part of it.
        assert m.handle == pytest.approx((-0.206, 0.0, 0.11)) and m.bar == pytest.approx((0.016, 0.0))
        assert m.case[0].color == pytest.approx((0.6, 0.4, 0.2))
    assert np.allclose(first.center, second.center) and np.allclose(first.inertia, second.inertia)
    seen = [part for part in (*first.case, *first.moving) if part.seen]
    assert len(seen) == 9 and not any(part.touched for part in seen)  # a URDF's colliders are hidden
    assert all(part.seen and part.touched for part in (*second.case, *second.moving))


def test_inertia_of_what_moves_is_about_its_centre(tmp_path: Path) -> None:
    """Two links fixed to one another: Steiner's theorem by hand."""
    m = body(written(tmp_path, cabinets.urdf())).mechanism
    places, masses = np.array([[0.1, 0, 0], [-0.05, 0, 0]]), np.array([1.2, 0.1])
    center = masses @ places / masses.sum()
    spread = masses @ ((places - center)[:, 0] ** 2)
    assert m.inertia.diagonal() == pytest.approx([0.0121, 0.0101 + spread, 0.0141 + spread])


def test_a_door_opens_to_the_limit_that_is_farther(tmp_path: Path) -> None:
    one = body(written(tmp_path, DOOR, "door.xml"), handle="knob", at=(0.65, 0.0))
    assert not one.slides and one.travel == pytest.approx(0.5 * math.pi) and one.axis == (0.0, 0.0, -1.0)
    assert one.mechanism.armature == 0.01 and one.mechanism.mass == pytest.approx(0.6)
    assert one.grip == pytest.approx((-0.16, -0.12, 0.1))
    assert one.grip_at(one.travel) == pytest.approx((-0.37, 0.21, 0.1))  # a quarter around (-0.1, 0.15)


def test_handles_by_name_and_by_place(tmp_path: Path) -> None:
    file = written(tmp_path, cabinets.mjcf(), "a.xml")
    by_link = body(file, handle="handle")
    for handle in ("middle", (-0.2, 0.0, 0.41)):  # a site; a point, where the file has the case 0.3 m high
        assert body(file, handle=handle).grip == pytest.approx(by_link.grip)
        assert body(file, handle=handle).bar == pytest.approx(by_link.bar)
    lying = body(written(tmp_path, cabinets.urdf(lying=True)))
    assert lying.bar == pytest.approx((0.016, 0.5 * math.pi))


def test_scale_keeps_the_density(tmp_path: Path) -> None:
    file = written(tmp_path, cabinets.urdf())
    whole, half = body(file).mechanism, body(file, scale=0.5, at=(0.6, 0.0)).mechanism
    assert half.travel == pytest.approx(0.1) and half.mass == pytest.approx(1.3 / 8)
    assert half.size == pytest.approx([0.5 * s for s in whole.size])
    assert np.allclose(half.inertia, whole.inertia / 32)


def test_one_of_several_joints_opens_and_the_others_are_held(tmp_path: Path) -> None:
    lid = (
        '<body name="lid" pos="0 0 0.25"><joint name="lid_hinge" axis="0 1 0" range="0.3 1"/>'
        '<geom size="0.1 0.1 0.01" mass="1"/></body>'
    )
    file = written(tmp_path, cabinets.mjcf(body=lid), "a.xml")
    slide, hinge = body(file, joint="slide").mechanism, body(file, joint="lid_hinge", handle="lid").mechanism
    assert (slide.slides, len(slide.moving)) == (True, 6) and slide.mass == pytest.approx(2.3)
    assert (hinge.slides, len(hinge.moving)) == (False, 1) and hinge.travel == pytest.approx(0.7)
    tilt = slide.moving[2].rotation  # the lid, held where it is closed
    assert math.atan2(tilt[0, 2], tilt[0, 0]) == pytest.approx(0.3)


def test_meshes_are_drawn_and_their_hulls_touched(tmp_path: Path) -> None:
    """An L from above: 4 of its 12 corners are inner ones, or on edges of the hull."""
    ring = [(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]
    lines = [f"v {x} {y} {z}" for z in (0, 1) for x, y in ring]
    lines += [f"f {k + 1} {(k + 1) % 6 + 1} {(k + 1) % 6 + 7} {k + 7}" for k in range(6)]
    lines += ["f 1 6 5 4 3 2", "f 7 8 9 10 11 12"]
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "ell.obj").write_text("\n".join(lines))
    scaled = 'filename="meshes/ell.obj" scale="0.05 0.05 0.05"'
    more = (
        f'<link name="block"><visual><geometry><mesh {scaled}/></geometry></visual>'
        f"<collision><geometry><mesh {scaled}/></geometry></collision></link>"
        '<joint name="glue" type="fixed"><parent link="drawer"/><child link="block"/><origin xyz="-0.2 0 0"/></joint>'
    )
    one = body(written(tmp_path, cabinets.urdf(more=more)))
    parts = [part for part in one.mechanism.moving if part.surface is not None]
    assert [(part.seen, part.touched, part.hull is not None) for part in parts] == [
        (True, False, False),
        (False, True, True),
    ]
    hull = parts[1].hull
    assert hull is not None and len(hull.vertices) == 10
    corners = hull.vertices[hull.faces]
    volume = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    assert volume == pytest.approx(3.5 * 0.05**3)  # of the L itself 3
    env = make(one)
    assert idle(env, 2).isfinite().all()
    package = more.replace("meshes/ell.obj", f"package://{tmp_path.name}/meshes/ell.obj")
    (tmp_path / "urdf").mkdir()
    assert len(body(written(tmp_path / "urdf", cabinets.urdf(more=package))).mechanism.moving) == 12


# -- in the simulation ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "lying"), [("a.urdf", False), ("a.xml", True)])
def test_the_expert_opens_it(name: str, lying: bool, tmp_path: Path) -> None:
    """Bars upright and lying, the latter grasped by a hand that is turned by a quarter."""
    text = cabinets.urdf(lying=lying) if name == "a.urdf" else cabinets.mjcf(lying=lying)
    env = make(body(written(tmp_path, text, name), spread=(0.02, 0.08), turn=0.15), 4)
    played = play_episodes(env, ExpertPolicy(env.simulation.task, env.kinematics, env.config), seed=1)
    assert played["success"].all() and env.statistics()["overflow"] == 0
    start = env.reset()["objects"][:, :2]
    assert start.std(0).min() > 0.005  # each episode draws where it stands


def test_it_stands_on_the_table_at_each_height(tmp_path: Path) -> None:
    """Where ``randomization.table_height`` draws one: handles are as much higher, and the expert finds them."""
    one = body(written(tmp_path, cabinets.urdf()))
    env = make(one, 4, randomization={"table_height": 0.08})
    higher = env.reset()["objects"][:, 2] - make(one, 4).reset()["objects"][:, 2]
    assert higher.std() > 0.02
    assert (higher - env.simulation.tensors.raised).abs().max() < 1e-4
    played = play_episodes(env, ExpertPolicy(env.simulation.task, env.kinematics, env.config), seed=1)
    assert played["success"].all() and env.statistics()["overflow"] == 0


def test_what_is_observed_is_where_newton_has_it(tmp_path: Path) -> None:
    """A door that turns: places and quaternions of the handle against Newton's body, and its limit."""
    env = make(
        body(written(tmp_path, DOOR, "door.xml"), handle="knob", at=(0.65, 0.0)), task="reach", gripper=True
    )
    env.reset()
    env.simulation.tensors.rest_qd.view(2, -1)[:, -1] = torch.tensor([1.0, 4.0])
    objects = idle(env, 8)
    frames = env.simulation.tensors.body_q[:, -1]
    assert (objects[:, :3] - frames[:, :3]).abs().max() < 1e-5
    assert ((objects[:, 3:7] * frames[:, 3:]).sum(-1).abs() - 1).abs().max() < 1e-5
    assert (objects[:, 13] > 0.1).all()
    assert (idle(env, 40)[:, 13] < 0.5 * math.pi + 0.05).all()


def test_it_is_heavy_and_stiff_as_the_file_says(tmp_path: Path) -> None:
    """Let go at 0.5 m/s: m a = −2 v − 1 N, over a tenth of a second."""
    env = make(body(written(tmp_path, cabinets.urdf())), 1)
    env.reset()
    env.simulation.tensors.rest_qd.view(1, -1)[:, -1] = 0.5
    speed = idle(env, 3)[0, -1].item()
    rate = 2.0 / 1.3
    assert speed == pytest.approx((0.5 + 1.0 / 2.0) * math.exp(-rate * 0.1) - 1.0 / 2.0, abs=0.01)


def test_images_and_numbers_of_case_and_what_moves(tmp_path: Path) -> None:
    """Segments as those of drawers: 12 the case, 13 what moves, in the colours of the file."""
    env = make(
        body(written(tmp_path, cabinets.urdf())),
        1,
        observations=("pixels", "segmentation"),
        cameras=("side",),
        image_size=96,
        camera_distance=1.3,
        camera_height=1.2,
        camera_target_distance=0.4,
        camera_target_height=0.0,
    )
    seen = env.reset()
    numbers, image = seen["segmentation"][..., 0], seen["pixels"].float()
    for number, color in ((12, (0.6, 0.4, 0.2)), (13, (0.1, 0.2, 0.9))):
        there = image[numbers == number]
        assert len(there) > 20
        hue = there / there.amax(-1, keepdim=True).clamp_min(1.0)
        assert (hue - torch.tensor(color) / max(color)).abs().max() < 0.1, number


def test_a_state_that_was_saved_goes_on_bit_for_bit(tmp_path: Path) -> None:
    env = make(body(written(tmp_path, cabinets.mjcf(), "a.xml"), spread=(0.02, 0.05)), episode_length=200)
    policy, observation = ExpertPolicy(env.simulation.task, env.kinematics, env.config), env.reset()
    for _ in range(30):
        observation = env.step(policy(observation.exclude("action")))["next"]
    saved, first = env.get_state(), []
    assert (observation["objects"][:, -2] > 0.01).any()  # it is on its way
    for turn in range(2):
        if turn:
            env.reset()
            observation = env.set_state(saved)
        for k in range(5):
            observation = env.step(policy(observation.exclude("action")))["next"]
            if turn:
                assert all(torch.equal(observation[key], first[k][key]) for key in OBSERVED), k
            else:
                first.append(observation.clone())


def test_the_hand_at_the_goal_is_turned_as_the_bar_is(tmp_path: Path) -> None:
    one = body(written(tmp_path, cabinets.urdf(lying=True)))
    env = make(one, observations=("goal_pixels", "state"), image_size=16)
    env.reset()
    t = env.simulation.tensors
    tool, yaw = env.kinematics.upright(t.goal_q)
    assert (tool - t.task_goal).norm(dim=-1).max() < 0.01
    assert torch.cos(2 * yaw).max() < -0.99 and (t.goal_rest[:, 0] - 0.008).abs().max() < 1e-6


def test_the_printed_cabinet_stands_in_a_scene(root: Path, tmp_path: Path, monkeypatch) -> None:
    page = (root / "docs" / "tasks.md").read_text()
    xml = next(b for b in re.findall(r"```xml\n(.*?)```", page, re.DOTALL) if "<robot" in b)
    text = next(b for b in re.findall(r"```yaml\n(.*?)```", page, re.DOTALL) if "cabinet.urdf" in b)
    monkeypatch.chdir(tmp_path)
    written(tmp_path, xml)
    scene = Scene.of(yaml.safe_load(text))
    env = make(scene.articulated[0], scene=scene)  # pyright: ignore[reportArgumentType]
    played = play_episodes(env, ExpertPolicy(env.simulation.task, env.kinematics, env.config), seed=1)
    assert played["success"].all()
