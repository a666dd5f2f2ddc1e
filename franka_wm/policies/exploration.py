"""How worlds explore while experience is gathered: noise of their own, and a share that acts with the planner."""

from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from tensordict.nn import InteractionType, TensorDictModuleBase
from tensordict.nn.probabilistic import interaction_type

from franka_wm import processes
from franka_wm.policies.planner import CONTEXT


class ExploringPolicy(TensorDictModuleBase):
    """A policy whose worlds explore unlike each other, so that planners and critics see more than its own actions.

    World k of N, of all processes, adds Gaussian noise of standard deviation `noise` · k / (N - 1) to its actions, as
    the actors of Ape-X (arXiv:1803.00933) have an ε each. The last `planner_worlds` of each process act with `planner`
    instead: a planner that is judged but never gathers meets states and actions that its model has not seen
    (arXiv:2502.03550).

    Nothing is changed where TorchRL's exploration type is not RANDOM.

    Args:
        policy: Writes `action` (N, A) in [-1, 1].
        noise: Standard deviation of the noisiest world, in units of the action.
        planner: Writes `action` and `plan`.
        planner_worlds: How many of this process's worlds, the last ones, act with it.

    Raises:
        ValueError: Planner worlds without a planner.
    """

    def __init__(
        self,
        policy: TensorDictModuleBase,
        *,
        noise: float = 0.0,
        planner: TensorDictModuleBase | None = None,
        planner_worlds: int = 0,
    ) -> None:
        super().__init__()
        if planner_worlds and planner is None:
            raise ValueError(f"planner_worlds={planner_worlds} needs a planner; leave it at 0")
        planner = planner if planner_worlds else None
        self.policy, self.noise, self.planner, self.planner_worlds = policy, noise, planner, planner_worlds
        # in_keys and out_keys are what a collector carries from step to step.
        more = [] if planner is None else [planner]
        self.in_keys = list(dict.fromkeys(key for one in (policy, *more) for key in one.in_keys))  # pyright: ignore[reportAttributeAccessIssue]
        self.out_keys = list(dict.fromkeys(key for one in (policy, *more) for key in one.out_keys))  # pyright: ignore[reportAttributeAccessIssue]

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action`, and the planner's entries."""
        worlds = tensordict.batch_size[0]
        first = worlds - self.planner_worlds
        seen = tensordict[first:]  # with the last executed action, before the policy writes its own
        tensordict = self.policy(tensordict)
        action = tensordict.get("action")
        if interaction_type() is not InteractionType.RANDOM:
            return tensordict
        if self.noise:
            # From the end: one world alone has all of the noise.
            whole, own = worlds * processes.count(), worlds * processes.rank()
            std = torch.linspace(self.noise, 0.0, whole, device=action.device).flip(0).unsqueeze(-1)
            std = std[own : own + worlds]
            action = (action + std * torch.randn_like(action)).clamp(-1.0, 1.0)
        if self.planner is not None:
            keys = dict.fromkeys([*self.planner.in_keys, "action", "plan", *CONTEXT])
            planned = self.planner(seen.select(*keys, strict=False))  # pyright: ignore[reportCallIssue]
            action = torch.cat((action[:first], planned.get("action")))
            for key in self.planner.out_keys:
                if key != "action":
                    own, others = planned.get(key), tensordict.get(key, None)
                    others = own.new_zeros(first, *own.shape[1:]) if others is None else others[:first]
                    tensordict.set(key, torch.cat((others, own)))
        if "context_action" in tensordict:  # a model with memory must remember what was really done
            tensordict.set("context_action", action)
        return tensordict.set("action", action)


class ActingPolicy(TensorDictModuleBase):
    """One of several policies, exchangeable while a collector runs it."""

    def __init__(self, policies: Mapping[str, TensorDictModuleBase], name: str):
        super().__init__()
        self.policies = dict(policies)  # a plain dict: the collector must not copy their models
        self.out_keys = ["action"]
        self.use(name)

    def use(self, name: str) -> None:
        self.name = name
        self.in_keys = list(self.policies[name].in_keys)  # pyright: ignore[reportAttributeAccessIssue]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self.policies[self.name](tensordict)
