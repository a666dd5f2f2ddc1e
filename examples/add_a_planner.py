"""A planner of your own: random shooting, the best of many candidates drawn at once.

python train.py plugins=[examples.add_a_planner] hydra.searchpath=[file://examples/conf] planner=shooting

`examples/conf/planner/shooting.yaml` holds its settings.
"""

import torch
from tensordict import TensorDict

from franka_wm.planning.registry import register


class Shooting:
    """Uniform candidates for all environments at once; the first action of the best is taken."""

    def __init__(self, *, action_dim: int, horizon: int = 3, num_samples: int = 256):
        self.action_dim, self.horizon, self.num_samples = action_dim, horizon, num_samples

    def plan(
        self, z, next, objective, *, prior=None, previous=None, is_init=None, explore=False, generator=None
    ):
        envs, samples = z.shape[0], self.num_samples
        shape = (envs, samples, self.horizon, self.action_dim)
        actions = 2 * torch.rand(shape, device=z.device, generator=generator) - 1
        latents = [z.unsqueeze(1).expand(envs, samples, *z.shape[1:])]
        for t in range(self.horizon):
            latents.append(next(latents[-1], actions[:, :, t]))
        score, best = objective(torch.stack(latents, 2), actions).max(1, keepdim=True)
        plan = actions.take_along_dim(best[..., None, None], 1).squeeze(1)
        return TensorDict({"action": plan[:, 0], "plan": plan, "value": score}, batch_size=[envs])


register("shooting", Shooting, line="random shooting, an example")
