# pyright: reportArgumentType=false
# (Warp's annotations do not know its own vectors.)
"""Where episodes start: nothing touches anything, and what cannot be played is refused before it is built."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.robots import SOURCES, Source, load_robot
from franka_wm.envs.scene import Scene
from franka_wm.envs.start import _box, _hand, _link_frames, _overlap, check_robot, check_start
from franka_wm.envs.tasks import Lift, Peg, Push, Task, TorchTask, register
from franka_wm.envs.tasks.manipulation import READY
from franka_wm.errors import UserError

CUBE = {"name": "cube", "at": [0.5, 0.0]}


BALL = {"name": "ball", "shape": "sphere", "size": [0.15], "at": [0.341, 0.226, 0.433]}
TALL = {"name": "tall", "size": [0.05, 0.05, 0.5]}


def wall(size: list[float], at: list[float]) -> dict:
    return {"name": "wall", "size": size, "at": at}


def block(height: float) -> dict:
    return {"name": "block", "shape": "socket", "size": [0.09, 0.036, height], "at": [0.6, 0.2]}


def configured(task: str = "lift", **changes: Any) -> FrankaConfig:
    values = {"observations": ("state", "joint_target", "objects", "contacts"), "gravity_compensation": True}
    return FrankaConfig(**(values | {"task": task, "pose_noise": 0.02} | changes))


def test_objects_stand_apart_where_some_draws_leave_no_room() -> None:
    """Of single draws in this room 4 % have no place for the last box: all are drawn anew then."""
    boxes = [{"name": f"box{k}", "at": [0.5, 0.0], "spread": [0.07, 0.07]} for k in range(4)]
    env = FrankaEnv(configured(scene={"objects": boxes}), num_envs=256, device="cpu", seed=3)
    for _ in range(3):
        places = env.reset()["objects"].view(256, 4, 13)[..., :2]
        assert (torch.cdist(places, places) + torch.eye(4)).min() > 0.04 * 2**0.5  # circles around 4 cm boxes


@pytest.mark.parametrize(("name", "width", "high"), [("object_size", 0.3, 0.2), ("table_height", 0.1, 0.15)])
def test_an_object_that_only_some_draws_put_into_the_hand_is_refused(
    name: str, width: float, high: float
) -> None:
    scene = {"objects": [{"name": "tall", "size": [0.05, 0.05, high], "at": [0.5, 0.0]}]}
    check_robot(configured(scene=scene))
    check_robot(configured(scene=scene, randomization={name: 0.01}))
    with pytest.raises(UserError, match=rf"scene\.tall: .*make it lower \(size, randomization\.{name}\)"):
        check_robot(configured(scene=scene, randomization={name: width}))


@pytest.mark.parametrize(
    ("goal", "said"),
    [
        ((0.5, 0.0, -0.2), "lies under it: scene.table"),
        ((0.5, 0.28, 0.1), "lies in it: scene.wall"),
        ((0.5, 0.25, 0.36), "lies in it: scene.ball"),
        ((0.5, 0.0, 0.1), None),
        ((0.5, 0.1, 0.25), None),
    ],
)
def test_a_goal_in_what_stands_there_is_refused(goal: tuple[float, ...], said: str | None) -> None:
    turned = wall([0.3, 0.2, 0.2], [0.5, 0.2, 0.1]) | {"angle": 1.57}
    scene = {"objects": [CUBE | {"at": [0.4, -0.2]}], "obstacles": [turned, BALL | {"at": [0.5, 0.25, 0.36]}]}
    config = configured("reach", gripper=True, goal=goal, goal_sampling="fixed", scene=scene)
    if said is None:
        return check_robot(config)
    with pytest.raises(UserError, match=said):
        check_robot(config)


@pytest.mark.parametrize(
    ("said", "changes"),
    [
        ("scene.tall: 0.5 m high, it may start in the hand", {"objects": [TALL]}),
        ("scene.wall: stands in the hand", {"obstacles": [wall([0.1, 0.1, 0.1], [0.5, 0.0, 0.35])]}),
        ("scene.wall: stands in the hand", {"obstacles": [wall([0.2, 0.01, 0.1], [0.5, 0.03, 0.31])]}),
        ("scene.ball: stands in the hand", {"obstacles": [BALL | {"at": [0.5, 0.15, 0.36]}]}),
        ("scene.wall: stands in the arm", {"obstacles": [wall([0.1, 0.1, 0.3], [0.1, 0.0, 0.5])]}),
        ("scene.table: stands in the hand", {"table": {"at": [0.35, 0.0, 0.3]}}),
        ("scene.table: stands in the hand", {"table": {"at": [0.5, 0.0, 0.6]}}),
        ("scene.table.at: with its top at -0.6 m, cube may start", {"table": {"at": [0.35, 0.0, -0.6]}}),
    ],
)  # fmt: skip
def test_a_scene_that_the_robot_would_start_in_is_refused(said: str, changes: dict) -> None:
    config = configured(scene={"objects": [CUBE]} | changes, collisions="arm")
    with pytest.raises(UserError) as caught:
        check_robot(config)
    assert said in str(caught.value) and "\n" not in str(caught.value)
    with pytest.raises(UserError):
        FrankaEnv(config, device="cpu")


@pytest.mark.parametrize(("away", "touch"), [(2.7, True), (3.0, False)])
def test_boxes_whose_edges_face_each_other(away: float, touch: bool) -> None:
    """Cubes of half side 1, turned by 45° about z and about y: their edges meet 2 √2 apart."""
    one, other = (
        wp.transform(wp.vec3(x, 0.0, 0.0), wp.quat_from_axis_angle(wp.vec3(*axis), math.pi / 4))
        for x, axis in ((0.0, (0.0, 0.0, 1.0)), (away, (0.0, 1.0, 0.0)))
    )
    assert _overlap(_box(one, (1, 1, 1)), _box(other, (1, 1, 1))) == touch


def test_the_hand_is_where_the_simulator_has_it() -> None:
    config = configured(pose_noise=0.0)
    robot = load_robot(config)
    expected = list(_hand(_link_frames(config, robot)[-1] * wp.transform(*robot.tool_frame)))
    env = FrankaEnv(config, device="cpu")
    env.reset()
    model, bodies = env.simulation.model, env.simulation.warp.body_q.numpy()[0]
    for label, box in zip(("hand/palm", "hand/pad0", "hand/pad1"), expected, strict=True):
        shape = model.shape_label.index(label)
        assert model.shape_body is not None and model.shape_transform is not None
        frame = wp.transform(*bodies[model.shape_body.numpy()[shape]])
        at = wp.transform_get_translation(frame * wp.transform(*model.shape_transform.numpy()[shape]))
        assert np.abs(np.array(at) - box.at).max() < 1e-3


@pytest.mark.parametrize(
    "changes",
    [
        {"obstacles": [wall([0.1, 0.1, 0.5], [0.5, 0.0, -0.35])]},  # a table's leg, under the cube
        {"obstacles": [wall([0.1, 0.1, 0.1], [0.5, 0.3, 0.35])]},  # beside the hand
        {
            "objects": [CUBE | {"at": [0.5, 0.3]}],
            "obstacles": [wall([0.2, 0.01, 0.1], [0.5, 0.0, 0.18])],
        },  # between fingers
        {"objects": [CUBE, TALL | {"at": [0.5, 0.4]}]},
        {"obstacles": [BALL]},  # corners of the box around it are in the palm
        {"obstacles": [BALL | {"shape": "cylinder", "size": [0.15, 0.4], "at": [0.36, 0.226, 0.433]}]},
    ],
)
def test_what_is_not_in_the_way_is_allowed(changes: dict) -> None:
    check_robot(configured(scene={"objects": [CUBE]} | changes, collisions="arm"))


def test_another_hand_is_not_guessed_at() -> None:
    config = configured(scene={"objects": [CUBE], "obstacles": [wall([0.1, 0.1, 0.1], [0.5, 0.0, 0.35])]})
    robot = load_robot(config)
    with pytest.raises(UserError, match=r"scene.wall: stands in the hand"):
        check_start(config, robot)
    other = robot.tool_frame.copy()
    other[2] -= 0.05
    check_start(config, replace(robot, tool_frame=other))


def test_a_drawer_that_seldom_leaves_no_room_is_refused() -> None:
    """In 3 of 256 draws, none of them among the first 32: drawing the cube anew does not move the drawer."""
    drawer = {
        "name": "chest",
        "kind": "drawer",
        "travel": 0.12,
        "at": [0.7, 0.0],
        "spread": [0.03, 0.05],
        "turn": 0.1,
    }
    with pytest.raises(UserError, match=r"scene.cube: stands in something else in 1 % of 256 draws"):
        configured(scene={"objects": [CUBE | {"at": [0.295, 0.2]}], "articulated": [drawer]})


def test_an_obstacle_over_a_tall_object_is_in_its_way() -> None:
    tall = TALL | {"at": [0.5, 0.4]}
    shelf = {"name": "shelf", "size": [0.2, 0.2, 0.02], "at": [0.5, 0.4, 0.4]}
    with pytest.raises(UserError, match=r"scene.tall: stands in something else in 100 %"):
        configured(scene={"objects": [tall], "obstacles": [shelf]})
    configured(scene={"objects": [CUBE | {"at": [0.5, 0.4]}], "obstacles": [shelf]})


@pytest.mark.parametrize(
    ("said", "task", "objects"),
    [
        ("scene.cube: task=push asks for a place 0.2 m ahead of it, 0.98 m from", "push", [CUBE | {"at": [0.78, 0.0]}]),
        ("scene.cube: 0.2 m wide; task=lift grasps it", "lift", [CUBE | {"size": [0.2, 0.2, 0.1]}]),
        ("with room for the first, 0.015 m deep", "peg", [CUBE | {"size": [0.03, 0.03, 0.1]}, block(0.015)]),
        ("with room for the first, 0.015 m deep", "peg", [CUBE | {"size": [0.05, 0.05, 0.1]}, block(0.04)]),
    ],
)  # fmt: skip
def test_a_task_that_the_scene_makes_impossible_is_refused(said: str, task: str, objects: list) -> None:
    with pytest.raises(UserError) as caught:
        configured(task, scene={"objects": objects})
    assert said in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"disc_radius": 0.0}, "disc_radius=0.0: must be from 0.02 to 0.1 (m)"),
        ({"disc_spread": 0.12}, "disc_spread=0.12: must be from 0 to 0.09 (m)"),
        (
            {"disc_spread": 0.09, "scene": {"objects": [CUBE | {"at": [0.53, 0.0]}]}},
            "0.29 m ahead of it, 0.82 m from",
        ),
        ({"task": "lift", "disc_spread": 0.05}, "disc_spread=0.05: task=lift does not read it, push does"),
    ],
)
def test_a_disc_out_of_reach_is_refused(changes: dict, said: str) -> None:
    with pytest.raises(UserError) as caught:
        configured(**({"task": "push"} | changes))
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_a_wide_object_may_be_pushed() -> None:
    configured("push", scene={"objects": [CUBE | {"size": [0.1, 0.1, 0.04]}]})


# -- tasks given as objects, and their classes ---------------------------------------------------------------


def test_a_task_given_as_an_object_is_checked_as_one_with_a_name() -> None:
    def made(task: type[Task], **changes: Any) -> FrankaEnv:
        config = FrankaConfig(observations=("state",), gripper=True, **changes)
        return FrankaEnv(config, device="cpu", task=task(config))

    with pytest.raises(UserError, match="is about 2 objects, the scene has 1"):
        made(Peg, scene={"objects": [CUBE]})
    with pytest.raises(UserError, match="reward='normalized': Lift has dense, sparse"):
        made(Lift, reward="normalized")
    with pytest.raises(UserError, match=r"scene.tall: 0.5 m high, it may start in the hand"):
        made(Lift, scene={"objects": [TALL]})


def test_what_a_class_says_is_checked_as_it_is_written() -> None:
    class Knock(TorchTask):
        gripper = True
        home = READY
        scene = {"objects": [CUBE]}  # pyright: ignore[reportAssignmentType]

    assert isinstance(Knock.scene, Scene) and Knock.scene.objects[0].name == "cube"
    with pytest.raises(UserError, match=r"Bent.home=\(0, 1\): give 7 joint angles"):
        type("Bent", (Task,), {"home": (0, 1)})
    for wrong in (configured, Lift(configured())):
        with pytest.raises(UserError, match="must be a class, a subclass of Task or TorchTask"):
            register("wrong", wrong)


def test_rewards_that_a_task_in_torch_does_not_have_are_refused(registries_as_before: None) -> None:
    register("mine", type("Mine", (TorchTask,), dict.fromkeys(("goal", "reward", "success"), id)))
    with pytest.raises(UserError, match="reward='sparse': must be one of dense"):
        FrankaConfig(task="mine", reward="sparse")
    assert not FrankaConfig(task="mine").fixed_goal


# -- a robot of one's own -------------------------------------------------------------------------------------


def test_a_robot_of_the_package_cannot_be_replaced() -> None:
    before = SOURCES["embedded"]
    for replace_it in (
        lambda: SOURCES.__setitem__("embedded", Source(lambda config: Path())),
        lambda: SOURCES.update(embedded=Source(lambda config: Path())),
        lambda: SOURCES.__ior__({"embedded": Source(lambda config: Path())}),
    ):
        with pytest.raises(
            UserError, match=r"^SOURCES\['embedded'\]: the package has this robot; choose another"
        ):
            replace_it()
    assert SOURCES["embedded"] is before


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Source(str), r"Source\(<class 'str'>\): must be a function that gives the path"),  # type: ignore[arg-type]
        (
            lambda: SOURCES.__setitem__("mine", lambda config: Path()),
            r"SOURCES\['mine'\]=<.*: must be Source\(",
        ),
        (
            lambda: Source("arm.urdf"),
            r"Source\('arm.urdf'\): must be a function .* \('arm.urdf' is not a callable",
        ),
        (
            lambda: Source(lambda: Path()),
            r"must be a function that .* for a FrankaConfig \(too many positional",
        ),
        (lambda: Source(lambda config: Path(), cell="fine"), r"cell='fine'\): must be a length in metres"),
    ],
)
def test_what_is_no_robot_is_one_line(make: Callable[[], Any], says: str) -> None:
    with pytest.raises(UserError, match=says):
        make()
    assert "mine" not in SOURCES


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (None, "NoneType"),
        (Path("no_such.urdf"), "'no_such.urdf'"),
        ("<robot name='arm'/>", "\"<robot name='arm'/>\""),
    ],
)
def test_a_robots_function_that_gives_no_file_is_named(given: object, says: str, monkeypatch) -> None:
    monkeypatch.setitem(SOURCES, "mine", Source(lambda config: given))
    with pytest.raises(
        UserError, match=f"^robot=mine: its function in SOURCES gave {says}; it must give the path"
    ):
        FrankaEnv(FrankaConfig(robot="mine"), device="cpu")


# -- what a name or a hand must not change --------------------------------------------------------------------


def test_an_object_named_as_a_finger_is_not_felt() -> None:
    env = FrankaEnv(
        configured(scene={"objects": [CUBE | {"name": "pad0", "mass": 2.0}]}), device="cpu", seed=0
    )
    observation = env.reset()
    for _ in range(5):
        observation = env.step(observation.set("action", torch.zeros(1, env.action_dim)))["next"]
    assert not observation["contacts"].any()


def test_a_disc_moved_by_hand_lies_on_the_table() -> None:
    """Else no cube on it is a success."""
    config = configured("push", randomization={"object_size": 0.2, "table_height": 0.05})
    env = FrankaEnv(config, num_envs=4, device="cpu", seed=0)
    cubes = env.reset()["objects"][:, :3]
    there = env.set_goal(cubes * torch.tensor([1.0, 1.0, 0.0]))
    torch.testing.assert_close(env.simulation.tensors.task_goal[:, 2], cubes[:, 2], atol=1e-3, rtol=0)
    assert (
        Push.marker is not None and env.step(there.set("action", torch.zeros(4, 8)))["next", "success"].all()
    )


def test_a_start_beyond_the_joints_limits_is_refused() -> None:
    """It would be moved within them without a word, and another pose be checked."""
    with pytest.raises(UserError, match=r"home: joint 2 at 2\.5 rad; its limits are -1\.78\d and 1\.78\d"):
        FrankaEnv(FrankaConfig(home=(0.0, 2.5, 0.0, -1.5, 0.0, 1.5, 0.0)), num_envs=1, device="cpu")


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"config": {"task": "reach"}}, "must be a FrankaConfig"),
        ({"seed": 1.5}, "seed=1.5"),
        ({"seed": "x"}, "seed="),
        ({"seed": -1}, "seed=-1"),
        ({"first_world": 2**40}, "first_world="),
        ({"first_world": -1}, "first_world=-1"),
        ({"num_envs": 2.5}, r"num_envs=2\.5"),
    ],
)
def test_what_is_no_argument_is_one_line(given: dict[str, Any], says: str) -> None:
    with pytest.raises(UserError, match=says) as caught:
        FrankaEnv(**({"num_envs": 1, "device": "cpu"} | given))
    assert "\n" not in str(caught.value)


def test_a_number_of_numpys_is_a_number_of_worlds() -> None:
    env = FrankaEnv(FrankaConfig(observations=("state",)), num_envs=np.int64(2), device="cpu")  # type: ignore[arg-type]
    assert env.reset().batch_size == (2,) and type(env.num_envs) is int


def test_another_default_than_float32_is_refused() -> None:
    torch.set_default_dtype(torch.float64)
    try:
        with pytest.raises(
            UserError, match=r"set_default_dtype\(torch\.float64\): worlds are simulated in float32; call"
        ):
            FrankaEnv(FrankaConfig(), num_envs=1, device="cpu")
    finally:
        torch.set_default_dtype(torch.float32)
