"""A TD-MPC2 from the vectors of a recorded dataset that has rewards, in code of your own.

    python examples/train_from_a_dataset.py user/name        a LeRobot dataset on the Hugging Face Hub
    python examples/train_from_a_dataset.py datasets/reach   one on disk, from `franka-wm collect` say

The same from the command line: python train.py dataset=lerobot dataset.repo_id=user/name trainer=offline env=none
"""

import sys
from pathlib import Path

import torch

from franka_wm import models
from franka_wm.data.lerobot import open_dataset
from franka_wm.training.learner import Learner

where = sys.argv[1]
updates = int(sys.argv[2]) if len(sys.argv) > 2 else 2000
device = "cuda" if torch.cuda.is_available() else "cpu"

# Decoded once into arrays beside the cache of other packages; the second time it opens at once.
source = {"root": where} if Path(where).is_dir() else {"repo_id": where}
windows = open_dataset(**source, window=3, batch_size=64, device=device, rewards_for="this example")
validation = windows.validation()
print(
    f"vectors {dict(windows.observation_sizes)}, images {dict(windows.image_sizes)}, actions {windows.action_dim}"
)

model = models.make(
    "tdmpc2",
    observation_sizes=windows.observation_sizes,
    action_dim=windows.action_dim,
    episode_length=windows.episode_length,
    latent_dim=128,
    hidden_dim=256,
).to(device)
statistics = windows.statistics()
mean, std = (torch.cat([statistics[key][i] for key in windows.observation_sizes]) for i in (0, 1))
model.set_observation_statistics(mean, std.clamp_min(1e-3))

learner = Learner(model)
for update in range(updates):
    learner.update(windows.sample())
    if (update + 1) % max(1, updates // 10) == 0:
        line = f"{update + 1:6d}   loss {learner.metrics()['loss']:.4f}"
        if validation is not None:
            with torch.no_grad():
                line += f"   on unseen episodes {float(model.loss(validation.sample())['loss']):.4f}"
        print(line)
