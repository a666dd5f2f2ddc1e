# pyright: reportAttributeAccessIssue=false
"""``collisions=arm`` and ``self``: which links touch what, against distances computed here; what stops the arm."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import mujoco
import mujoco_warp
import numpy as np
import pytest
import torch
import warp as wp

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.robots import links
from franka_wm.envs.robots.gripper import PALM
from franka_wm.errors import UserError

PRESET: dict[str, Any] = {
    "task": "reach",
    "gripper": True,
    "scene": {},
    "observations": ("state", "joint_target"),
    "substeps": 4,
    "pose_noise": 0.0,
    "limit_velocity": True,
    "gravity_compensation": True,
    "episode_length": 200,
}
TABLE = (np.array([0.35, 0.0, -0.025]), np.eye(3), np.array([0.55, 0.70, 0.025]))
CLOSE = 0.004
"""Distances are right within this: capsules are points here [m]."""


def make(num_envs: int, collisions: str, **changes: Any) -> FrankaEnv:
    values: dict[str, Any] = PRESET | {"collisions": collisions} | changes
    return FrankaEnv(FrankaConfig(**values), num_envs=num_envs, device="cpu", seed=0)


class Thing:
    """A box, or a capsule as 15 points and a radius, in N poses."""

    def __init__(self, place: np.ndarray, turn: np.ndarray, size: np.ndarray, *, capsule: bool = False):
        self.place, self.turn, self.size = place, turn, size
        if capsule:
            local, self.radius = np.linspace(-size[1], size[1], 15)[:, None] * [0.0, 0.0, 1.0], size[0]
        else:
            grid = np.array(list(itertools.product(np.linspace(-1, 1, 9), repeat=3)))
            local, self.radius = grid * size, 0.0
        self.box = not capsule
        self.points = np.einsum("...ij,pj->...pi", turn, local) + place[..., None, :]

    def outside(self, points: np.ndarray) -> np.ndarray:
        """Signed distance of points (N, P, 3) to the box (N, P)."""
        local = np.einsum("...ji,...pj->...pi", self.turn, points - self.place[..., None, :])
        away = np.abs(local) - self.size
        return np.linalg.norm(np.maximum(away, 0), axis=-1) + np.minimum(away.max(-1), 0)

    def to(self, other: Thing) -> np.ndarray:
        """Least distance (N,) [m]."""
        if not self.box and not other.box:
            pairs = np.linalg.norm(self.points[..., :, None, :] - other.points[..., None, :, :], axis=-1)
            return pairs.min((-1, -2)) - self.radius - other.radius
        found = []
        for one, two in ((self, other), (other, self)):
            if one.box:
                found.append(one.outside(two.points).min(-1) - two.radius)
        return np.minimum.reduce(found)


def poses(env: FrankaEnv, q: torch.Tensor) -> None:
    """MuJoCo's frames and contacts of joints (N, 7), the fingers half open."""
    model, data = env.simulation.solver.mjw_model, env.simulation.solver.mjw_data
    full = torch.full((len(q), 9), 0.02)
    full[:, :7] = q
    wp.copy(data.qpos, wp.from_torch(full))
    mujoco_warp.kinematics(model, data)
    mujoco_warp.collision(model, data)


def things(env: FrankaEnv) -> list[tuple[int, Thing]]:
    """Links' numbers (the hand is 7, the table −1) and what is there of them."""
    data, n = env.simulation.solver.mjw_data, env.num_envs
    place = data.xpos.numpy().astype(np.float64)
    turn = data.xmat.numpy().astype(np.float64).reshape(n, -1, 3, 3)
    out = [(-1, Thing(*(np.broadcast_to(a, (n, *a.shape)) for a in TABLE[:2]), TABLE[2]))]
    for part in links._embedded()[1]:
        frame = np.array(list(part.frame))
        own = np.array(wp.quat_to_matrix(wp.quatf(*frame[3:].tolist()))).reshape(3, 3)
        at = place[:, part.link] + np.einsum("nij,j->ni", turn[:, part.link], frame[:3])
        size = np.array(part.scale)
        out.append((part.link, Thing(at, turn[:, part.link] @ own, size, capsule=not part.box)))
    solver = env.simulation.solver.mj_model
    for geom in range(solver.ngeom):
        if (
            np.allclose(solver.geom_size[geom], PALM) or solver.geom_bodyid[geom] > 7
        ):  # the palm and the fingers
            body = solver.geom_bodyid[geom]
            own = np.zeros(9)
            mujoco.mju_quat2Mat(own, solver.geom_quat[geom])
            at = place[:, body] + np.einsum("nij,j->ni", turn[:, body], solver.geom_pos[geom])
            out.append((7, Thing(at, turn[:, body] @ own.reshape(3, 3), solver.geom_size[geom])))
    return out


def nearest(env: FrankaEnv, *, itself: bool) -> np.ndarray:
    """Distance (N,) of the nearest two things that may touch [m]."""
    least = np.full(env.num_envs, np.inf)
    for (i, a), (j, b) in itertools.combinations(things(env), 2):
        with_table = i == -1 and j != 0
        if with_table or (itself and i >= 0 and abs(i - j) > links.NEIGHBOURS):
            least = np.minimum(least, a.to(b))
    return least


def touching(env: FrankaEnv) -> np.ndarray:
    """(N,) bool."""
    data = env.simulation.solver.mjw_data
    count = int(data.nacon.numpy()[0])
    worlds = data.contact.worldid.numpy()[:count][data.contact.dist.numpy()[:count] < 0]
    return np.isin(np.arange(env.num_envs), worlds)


@pytest.mark.parametrize("collisions", ["arm", "self"])
def test_links_touch_where_they_are_and_nowhere_else(collisions: str) -> None:
    """Home and 999 random poses within the joints' limits: contacts exactly where something penetrates."""
    env = make(1000, collisions)
    k = env.kinematics
    shares = torch.rand(1000, 7, generator=torch.Generator().manual_seed(0))
    q = k.lower + shares * (k.upper - k.lower)
    q[0] = torch.tensor(env.config.start_pose)
    poses(env, q)
    far, there = nearest(env, itself=collisions == "self"), touching(env)
    assert far[0] > 0.05 and not there[0]
    clear, deep = far > CLOSE, far < -CLOSE
    assert clear.sum() > 100 and deep.sum() > 20, (clear.sum(), deep.sum())
    assert not there[clear].any(), np.nonzero(there & clear)[0][:5]
    assert there[deep].all(), np.nonzero(~there & deep)[0][:5]


def test_a_full_scene_leaves_neighbours_alone() -> None:
    """At home, among ten objects, obstacles and drawers, what touches is objects and the table."""
    objects = [{"name": f"cube{k}", "at": [0.25 + 0.1 * k, -0.35]} for k in range(5)]
    objects += [
        {"name": f"can{k}", "shape": "cylinder", "size": [0.02, 0.1], "at": [0.25 + 0.1 * k, 0.35]}
        for k in range(5)
    ]
    scene = {
        "objects": objects,
        "obstacles": [
            {"name": f"wall{k}", "size": [0.02, 0.02, 0.1], "at": [0.2 + 0.1 * k, -0.55, 0.05]}
            for k in range(4)
        ],
        "articulated": [{"name": "chest", "at": [0.72, 0.0], "spread": [0, 0], "travel": 0.1}],
        "table": {"size": [1.5, 1.6, 0.05], "at": [0.5, 0.0, 0.0]},
    }
    env = make(2, "self", scene=scene)
    root, action = env.reset(), torch.zeros(2, 8)
    for _ in range(3):
        root = env.step(root.set("action", action))["next"]
    data = env.simulation.solver.mjw_data
    pairs = data.contact.geom.numpy()[: int(data.nacon.numpy()[0])]
    bodies = env.simulation.solver.mj_model.geom_bodyid[pairs]
    assert len(pairs) > 40 and (bodies.max(1) > 9).all()  # 9 are the arm's and the fingers'
    assert not ((bodies > 0) & (bodies <= 9)).any()
    assert env.statistics()["overflow"] == 0


@pytest.mark.parametrize(("collisions", "stops"), [("hand", False), ("arm", True), ("self", True)])
def test_a_forearm_is_stopped(collisions: str, stops: bool) -> None:
    """The arm turns around its base; a wall stands where the upper arm passes, out of the hand's way."""
    wall = {"name": "wall", "size": [0.05, 0.05, 0.5], "at": [0.02, 0.2, 0.25]}
    env = make(
        1,
        collisions,
        scene={"obstacles": [wall]},
        home=(0.0, 0.9, 0.0, -1.5, 0.0, 2.4, 0.785),
        action_scale=0.05,
    )
    root, action = env.reset(), torch.zeros(1, 8)
    action[:, 0] = 1.0
    deepest = 0.0
    for _ in range(60):
        root = env.step(root.set("action", action))["next"]
        data = env.simulation.solver.mjw_data
        count = int(data.nacon.numpy()[0])
        deepest = min(deepest, data.contact.dist.numpy()[:count].min(initial=0.0))
    turned = float(root["state"][0, 0])
    assert (turned < 1.6) == stops and turned > 0.2, turned
    assert deepest > -0.01 and env.statistics()["overflow"] == 0


def test_hand_alone_is_what_it_was() -> None:
    """The default builds no shape more."""
    counts = {mode: make(1, mode).simulation.model.shape_count for mode in ("hand", "arm", "self")}
    assert FrankaConfig().collisions == "hand"
    assert counts["arm"] == counts["self"] == counts["hand"] + len(links._embedded()[1])


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"collisions": "all"}, "collisions='all': must be one of hand, arm, self"),
        ({"collisions": "arm"}, "collisions=arm: task=reach touches nothing; give a scene"),
    ],
)
def test_what_cannot_be_is_one_line(changes: dict, said: str) -> None:
    with pytest.raises(UserError) as caught:
        FrankaConfig(**changes)
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_an_arm_of_another_shape_is_refused(root: Path, tmp_path: Path) -> None:
    text = (root / "franka_wm" / "envs" / "robots" / "fr3.urdf").read_text()
    assert text.count('xyz="0 -0.316 0"') == 1
    (tmp_path / "long.urdf").write_text(text.replace('xyz="0 -0.316 0"', 'xyz="0 -0.416 0"'))
    config = FrankaConfig(**PRESET, collisions="arm", robot="urdf")
    with pytest.raises(UserError, match="its joints elsewhere; set it to hand"):
        FrankaEnv(config, num_envs=1, device="cpu", urdf_path=tmp_path / "long.urdf")
