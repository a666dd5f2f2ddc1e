# pyright: reportAttributeAccessIssue=false
# (MuJoCo is compiled: pyright sees none of its names.)
"""Free bodies move as in MuJoCo's own C library: falling, landing, sliding, pushing one another."""

from __future__ import annotations

import mujoco
import numpy as np
import torch

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.scene import Body, Scene

SECONDS, EDGE = 1.0, 0.04
SOLID = 'condim="3" friction="0.4 0.005 0.0001" solref="0.02 1" solimp="0.95 0.99 0.001 0.5 2"'
XML = f"""
<mujoco>
  <option timestep="{1 / 120}" cone="elliptic" impratio="10" integrator="implicitfast" iterations="50"
    ls_iterations="50"/>
  <worldbody>
    <geom type="box" size="0.55 0.7 0.025" pos="0.35 0 -0.025" {SOLID}/>
    <body pos="0.45 0.2 0.02"><freejoint/><geom type="box" size="0.02 0.02 0.02" mass="0.05" {SOLID}/></body>
    <body pos="0.55 0.2 0.02"><freejoint/><geom type="box" size="0.02 0.02 0.02" mass="0.1" {SOLID}/></body>
  </worldbody>
</mujoco>
"""


def in_mujoco(q: np.ndarray, qd: np.ndarray) -> np.ndarray:
    """(T, 2, 3) places after every control step; q (14,) and qd (12,) as Newton has them."""
    model = mujoco.MjModel.from_xml_string(XML)
    data = mujoco.MjData(model)
    for b in range(2):
        place, turned = q[7 * b : 7 * b + 3], q[7 * b + 3 : 7 * b + 7]
        data.qpos[7 * b : 7 * b + 7] = [*place, turned[3], *turned[:3]]
        data.qvel[6 * b : 6 * b + 6] = qd[
            6 * b : 6 * b + 6
        ]  # no spin at the start: the frame does not matter
    out = []
    for _ in range(round(30 * SECONDS)):
        mujoco.mj_step(model, data, nstep=4)
        out.append([data.qpos[7 * b : 7 * b + 3].copy() for b in range(2)])
    return np.array(out)


def test_one_second_of_falling_sliding_and_being_pushed() -> None:
    """Four worlds: a cube falls and lies, slides to rest, slides into a heavier one, falls onto that one and lies.

    Faster than that (1 m/s into the other cube) it tumbles, and the two libraries differ by up to 4 mm on the way:
    they find other contact points of two boxes.
    """
    cubes = (Body(name="a", at=(0.45, 0.2)), Body(name="b", at=(0.55, 0.2), mass=0.1))
    config = FrankaConfig(
        task="reach", gripper=True, scene=Scene(objects=cubes), observations=("state", "objects"), substeps=4,
        gravity_compensation=True, pose_noise=0.0, solver_iterations=50, solver_ls_iterations=50, episode_length=100,
    )  # fmt: skip
    env = FrankaEnv(config, num_envs=4, device="cpu", seed=0)
    observation, t = env.reset(), env.simulation.tensors
    t.rest_q[0, 4] = 0.10  # z of the first cube, behind the fingers, x and y
    t.rest_qd[1, 3] = 0.6  # its speed along y
    t.rest_q[2, 2], t.rest_qd[2, 2] = 0.505, 0.7  # along x, from 5 mm before the second cube
    t.rest_q[3, 2:5] = torch.tensor([0.54, 0.2, 0.08])
    starts = [
        (t.rest_q[k, 2:].double().numpy().copy(), t.rest_qd[k, 2:].double().numpy().copy()) for k in range(4)
    ]
    played, action = [], torch.zeros(4, 8)
    for _ in range(round(30 * SECONDS)):
        observation = env.step(observation.set("action", action))["next"]
        played.append(observation["objects"].view(4, 2, 13)[..., :3].clone())
    places = torch.stack(played, 1).double().numpy()  # (4, T, 2, 3)
    for world, (q, qd) in enumerate(starts):
        expected = in_mujoco(q, qd)
        moved = np.abs(expected[-1] - [[0.45, 0.2, 0.02], [0.55, 0.2, 0.02]]).max()
        assert world == 0 or moved > 0.005, world  # something happened
        if world == 2:
            assert abs(expected[-1, 1, 0] - 0.55) > 0.005  # the heavier one was pushed
        off = np.linalg.norm(places[world] - expected, axis=-1).max()
        assert off < 1e-3, (world, off)
