"""Sizes of objects, drawn anew in each episode: what touches, weighs, is seen, starts and pays by them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.scene import Body, Obstacle, Scene
from franka_wm.errors import UserError
from franka_wm.evaluation.closed_loop import play_episodes
from franka_wm.policies.expert import ExpertPolicy
from franka_wm.training.settings import RunSettings
from presets import LIFT

WIDTH = 0.3
ROOM = Scene(
    objects=(
        Body(name="cube", at=(0.5, 0.0), spread=(0.05, 0.1), turn=0.5),
        Body(name="ball", shape="sphere", size=(0.03,), at=(0.5, -0.35), mass=0.1),
        Body(name="can", shape="cylinder", size=(0.02, 0.08), at=(0.4, 0.3)),
        Body(name="block", shape="socket", size=(0.09, 0.036, 0.04), at=(0.6, 0.3), mass=0.5),
    )
)
HALVES = torch.tensor([0.02, 0.03, 0.04, 0.02])


def make(num_envs: int, *, seed: int = 0, size: float = WIDTH, **changes: Any) -> FrankaEnv:
    values = LIFT | {"scene": ROOM} | changes
    ranges = {"object_size": size} | values.pop("randomization", {})
    return FrankaEnv(FrankaConfig(**values, randomization=ranges), num_envs=num_envs, device="cpu", seed=seed)


def still(env: FrankaEnv, root, steps: int):
    action = torch.zeros(env.num_envs, env.action_dim)
    action[:, -1] = 1.0
    for _ in range(steps):
        root = env.step(root.set("action", action))["next"]
    return root


@pytest.fixture(scope="module")
def sized() -> FrankaEnv:
    return make(8)


def test_geometry_mass_and_inertia_follow(sized: FrankaEnv) -> None:
    """MuJoCo's own arrays, as a scene of that size would have them; each world and episode its own."""
    sized.reset(seed=1)
    first = sized.simulation.tensors.sizes.clone()
    sized.reset(seed=2)
    sizes = sized.simulation.tensors.sizes
    assert (
        (first != sizes).all()
        and ((sizes - 1).abs() <= WIDTH).all()
        and (sizes - 1).abs().max() > 0.7 * WIDTH
    )
    got = sized.simulation.solver.mjw_model
    for world in (0, 5):
        bodies = [
            Body(
                name=b.name, shape=b.shape, size=tuple(float(f) * s for s in b.size), at=b.at,
                mass=b.mass * float(f) ** 3,
            )
            for b, f in zip(ROOM.objects[:3], sizes[world], strict=False)  # a socket's plate grows, too
        ]  # fmt: skip
        plain = make(1, size=0.0, scene=Scene(objects=tuple(bodies))).simulation.solver.mjw_model
        for name in (
            "geom_size",
            "geom_pos",
            "geom_rbound",
            "geom_aabb",
            "body_mass",
            "body_inertia",
            "body_invweight0",
        ):
            of_it = getattr(plain, name).numpy()[0]
            np.testing.assert_allclose(
                getattr(got, name).numpy()[world][: len(of_it)], of_it, rtol=2e-4, atol=1e-7, err_msg=name
            )
        block = (
            got.geom_size.numpy()[world, -5:]
            / make(1, size=0.0).simulation.solver.mjw_model.geom_size.numpy()[0, -5:]
        )
        np.testing.assert_allclose(block, float(sizes[world, 3]), rtol=1e-5)
        low = make(1, size=0.0).simulation.solver.mjw_model.body_ipos.numpy()[0, -1]
        assert abs(low[2]) > 1e-4, "a socket's plate makes it heavier below"
        centre = got.body_ipos.numpy()[world, -1]
        np.testing.assert_allclose(centre, low * float(sizes[world, 3]), rtol=1e-4, atol=1e-8)


def test_they_start_on_the_table_apart_and_stay(sized: FrankaEnv) -> None:
    root = sized.reset(seed=3)
    sizes = sized.simulation.tensors.sizes
    start = root["objects"].view(8, 4, 13).clone()
    assert torch.allclose(start[..., 2], HALVES * sizes, atol=1e-4)
    contacts = sized.simulation.solver.mjw_data
    after = still(sized, root, 20)["objects"].view(8, 4, 13)
    assert (after[..., :3] - start[..., :3]).abs().max() < 1e-3
    count = int(contacts.nacon.numpy()[0])
    assert contacts.contact.dist.numpy()[:count].min() > -1e-3
    assert sized.statistics()["overflow"] == 0
    crowd = Scene(objects=tuple(Body(name=f"b{k}", spread=(0.1, 0.2), turn=1.0) for k in range(6)))
    env = make(128, scene=crowd)
    places, sizes = env.reset()["objects"].view(128, 6, 13)[..., :2], env.simulation.tensors.sizes
    radii = 0.02 * math.sqrt(2) * sizes
    gaps = torch.cdist(places, places) - radii[:, :, None] - radii[:, None, :] + 9 * torch.eye(6)
    assert gaps.min() > 0.0099


def test_they_last_an_episode_and_are_saved(sized: FrankaEnv) -> None:
    root = sized.reset(seed=4)
    sizes, saved = sized.simulation.tensors.sizes.clone(), sized.get_state()
    touched = sized.simulation.solver.mjw_model.geom_size.numpy().copy()
    first = still(sized, root, 10)["objects"].clone()
    assert torch.equal(sizes, sized.simulation.tensors.sizes)
    sized.reset(seed=5)
    assert not np.array_equal(touched, sized.simulation.solver.mjw_model.geom_size.numpy())
    sized.set_state(saved)
    assert torch.equal(sizes, sized.simulation.tensors.sizes)
    assert np.array_equal(touched, sized.simulation.solver.mjw_model.geom_size.numpy())
    assert torch.equal(first, still(sized, root, 10)["objects"])


def test_a_world_is_the_same_whatever_their_number() -> None:
    runs = []
    for n in (1, 8):
        env = make(
            n,
            scene=Scene(objects=ROOM.objects[:3]),
            episode_length=3,
            randomization={"mass": 0.2, "contact_friction": 0.2},
        )
        root, out = env.reset(seed=4), []
        for k in range(5):
            action = torch.sin(torch.arange(8.0) + k).expand(n, 8).contiguous()
            step, root = env.step_and_maybe_reset(root.set("action", action))
            out.append(torch.cat([step["next", "objects"][0], env.simulation.tensors.sizes[0]]))
        runs.append(torch.stack(out))
    assert torch.equal(*runs)


def test_a_grown_object_does_not_start_in_what_hangs_above_a_plain_one() -> None:
    """A shelf 2 cm above a tower of 30 cm, which may be 36 cm high."""
    tower = Body(name="tower", size=(0.05, 0.05, 0.3), at=(0.5, 0.25), spread=(0.12, 0.2))
    shelf = Obstacle(name="shelf", size=(0.06, 0.06, 0.04), at=(0.5, 0.25, 0.34))
    env = make(64, size=0.2, task="reach", gripper=True, scene=Scene(objects=(tower,), obstacles=(shelf,)))
    root = env.reset()
    away = (root["objects"][:, :2] - torch.tensor([0.5, 0.25])).abs().amax(1)
    assert away.min() > 0.03 + 0.025 and away.max() > 0.1
    assert still(env, root, 3)["objects"][:, 7:10].abs().max() < 1e-3, "none is pushed out of the shelf"


def test_cameras_see_the_size() -> None:
    """The same pixels as of a scene whose objects have that size."""
    look: dict[str, Any] = {
        "observations": ("pixels", "segmentation"), "camera_distance": 0.9, "camera_height": 0.5,
        "camera_target_distance": 0.5, "camera_target_height": 0.0, "pose_noise": 0.0,
    }  # fmt: skip
    where: dict[str, Any] = {"name": "cube", "at": (0.5, 0.0)}
    env = make(4, scene=Scene(objects=(Body(**where),)), **look)
    seen, sizes = env.reset(seed=6), env.simulation.tensors.sizes[:, 0].tolist()
    counts = (seen["segmentation"] == 12).sum((1, 2, 3)).tolist()
    assert (
        sorted(counts) == [n for _, n in sorted(zip(sizes, counts, strict=True))]
        and counts.count(counts[0]) < 4
    )
    same = Body(**where, size=(0.04 * sizes[2],) * 3)
    plain = make(1, size=0.0, scene=Scene(objects=(same,)), **look).reset()
    assert (seen["segmentation"][2] != plain["segmentation"][0]).float().mean() < 2e-3


@pytest.mark.parametrize("name", ["lift", "pick", "push", "stack"])
def test_tasks_and_experts_follow(name: str, composed) -> None:
    """Each expert reaches its task's success in 16 worlds, with cubes from 3.2 to 4.8 cm."""
    config = RunSettings.of(composed(f"env={name}", "env.randomization.object_size=0.2")).env.arm
    env = FrankaEnv(config, num_envs=16, device="cpu", seed=1)
    played = play_episodes(env, ExpertPolicy(env.simulation.task, env.kinematics, config), seed=1)
    assert played["success_once"].mean() >= 15 / 16, played["success_once"]


def test_a_stack_of_other_sizes_is_one() -> None:
    """The upper cube put on the lower one by hand succeeds in each world."""
    env = make(4, task="stack", scene=None)
    root, t = env.reset(), env.simulation.tensors
    goal = 0.02 * t.sizes[:, 0] + 0.04 * t.sizes[:, 1]
    assert torch.allclose(t.task_goal[:, 2], goal, atol=1e-4)
    t.rest_q[:, 2:4], t.rest_q[:, 5:9] = t.rest_q[:, 9:11], t.rest_q[:, 12:16]
    t.rest_q[:, 4] = goal
    assert still(env, root, 8)["success"].all()


def test_a_stack_of_an_own_scene_is_one() -> None:
    """A brick upright on a plate, and one that stands too far from the plate's middle."""
    brick = Body(name="brick", size=(0.05, 0.03, 0.06), at=(0.45, 0.1))
    plate = Body(name="plate", size=(0.14, 0.06, 0.03), at=(0.5, -0.1))
    env = make(2, size=0.0, task="stack", scene=Scene(objects=(brick, plate)))
    root, t = env.reset(), env.simulation.tensors
    assert torch.allclose(t.task_goal, torch.tensor([0.5, -0.1, 0.06]), atol=1e-4)
    t.rest_q[:, 2:5] = t.task_goal
    t.rest_q[1, 2] += 0.5 * 0.06 + 0.005 + 0.003
    after = still(env, root, 8)
    assert after["success"].flatten().tolist() == [True, False]
    assert (after["objects"][:, 2] - 0.06).abs().max() < 1e-3  # both stand on it


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"task": "reach", "randomization": {"object_size": 0.2}}, "object_size: needs objects"),
        ({"task": "peg", "randomization": {"object_size": 0.2}}, "the peg would not fit its hole"),
        ({"randomization": {"object_size": 0.6}}, "must be from 0 to 0.5"),
        (
            {"scene": {"objects": [{"name": "a", "at": [0.5, 0.0]}, {"name": "b", "at": [0.57, 0.0]}]},
             "randomization": {"object_size": 0.2}},
            "objects of 1.2 times their size: scene.b: stands in something else",
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_is_one_line(changes: dict, said: str) -> None:
    with pytest.raises(UserError) as caught:
        FrankaConfig(**({"task": "lift", "observations": ("state",)} | changes))
    assert said in str(caught.value) and "\n" not in str(caught.value)
