"""What the presets promise of the arm, and that the names of the same task mean the same."""

from pathlib import Path

import torch
import yaml

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.gym import REACH_V0

CONF = Path(__file__).parents[2] / "conf" / "env"


def reach_preset() -> dict:
    values = yaml.safe_load((CONF / "reach.yaml").read_text())
    values.pop("defaults")
    return values


def test_the_gymnasium_task_is_the_reach_preset():
    preset = reach_preset()
    preset.pop("observations")
    assert {key: REACH_V0[key] for key in preset} == preset


def test_the_preset_holds_still_and_moves_far():
    config = FrankaConfig(**(reach_preset() | {"pose_noise": 0.0}))
    env = FrankaEnv(config, num_envs=2, device="cpu")
    actions = torch.zeros(2, 12, 7)
    actions[1, :, 3] = 1.0  # stretch the elbow; world 0 idles
    rollout = env.rollout_actions(actions, seed=0)
    drift = (rollout["joint_q"][0] - rollout["joint_q"][0, :1]).abs().max()
    sweep = (rollout["tool"][1, -1] - rollout["tool"][1, 0]).norm()
    assert drift < 0.007
    assert sweep >= 0.4
