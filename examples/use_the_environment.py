"""The arm in TorchRL code of your own: specs, a rollout, a collector, a replay buffer.

python examples/use_the_environment.py
"""

import torch
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs.utils import check_env_specs

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.policies.scripted import IKPolicy

config = FrankaConfig(
    observations=("pixels", "state", "joint_target"),
    goal_sampling="reachable",
    gravity_compensation=True,
    substeps=4,
    image_size=32,
    episode_length=20,
)
env = FrankaEnv(config, num_envs=16, seed=0)  # on the GPU if there is one
check_env_specs(env)

# One episode of every world, by inverse kinematics.
policy = IKPolicy(env.kinematics, config)
episode = env.rollout(config.episode_length, policy, break_when_any_done=False)
final = episode["next", "state"][:, -1, 17:20].norm(dim=-1)
print(f"distance to the goal after {config.episode_length} steps: {100 * final.mean():.2f} cm")

# Experience with random actions, into a buffer on the same device.
replay = ReplayBuffer(storage=LazyTensorStorage(10_000, device=env.device), batch_size=64)
for batch in Collector(env, policy=None, frames_per_batch=16 * 10, total_frames=16 * 40):
    replay.extend(batch.reshape(-1))
sample = replay.sample()
assert sample["pixels"].dtype == torch.uint8
print(f"{len(replay)} transitions; a sample has pixels {tuple(sample['pixels'].shape)}, on {sample.device}")
