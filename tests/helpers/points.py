# pyright: reportArgumentType=false, reportCallIssue=false
"""Points that actions move: an environment without a simulator."""

import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

GOAL = 2.0


class Points(EnvBase):
    """N points that move by their action; point n's episode lasts 3 + n steps."""

    def __init__(self, n: int = 3) -> None:
        super().__init__(device="cpu", batch_size=[n])
        self.observation_spec = Composite(state=Unbounded((n, 2)), shape=(n,))
        self.action_spec = Bounded(-1.0, 1.0, (n, 2))
        self.reward_spec = Unbounded((n, 1))
        flag = Unbounded((n, 1), dtype=torch.bool)
        self.full_done_spec = Composite(
            done=flag.clone(), terminated=flag.clone(), truncated=flag.clone(), shape=(n,)
        )
        self.lengths = 3 + torch.arange(n).unsqueeze(-1)
        self.steps = torch.zeros(n, 1, dtype=torch.int64)
        self.state = torch.zeros(n, 2)

    def _reset(self, tensordict=None):
        chosen = None if tensordict is None else tensordict.get("_reset", None)
        where = torch.ones_like(self.steps, dtype=torch.bool) if chosen is None else chosen.view(-1, 1)
        self.steps = torch.where(where, 0, self.steps)
        self.state = torch.where(where, torch.rand_like(self.state), self.state)
        no = torch.zeros_like(where)
        return TensorDict(
            {"state": self.state, "done": no, "terminated": no.clone(), "truncated": no.clone()},
            self.batch_size,
        )

    def _step(self, tensordict):
        self.state, self.steps = self.state + tensordict["action"], self.steps + 1
        truncated = self.steps >= self.lengths
        reward = -(self.state - GOAL).norm(dim=-1, keepdim=True)
        return TensorDict(
            {
                "state": self.state,
                "reward": reward,
                "done": truncated,
                "truncated": truncated.clone(),
                "terminated": torch.zeros_like(truncated),
            },
            self.batch_size,
        )

    def _set_seed(self, seed):
        torch.manual_seed(0 if seed is None else seed)
