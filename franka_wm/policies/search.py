"""A policy that a TorchRL collector can run: tree search over a world model with discrete actions."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from franka_wm.models.base import WorldModel
from franka_wm.planning.mcts import MCTS
from franka_wm.planning.tree import CompiledRecurrent, Recurrent
from franka_wm.policies.capture import GraphCache
from franka_wm.policies.graph_key import graph_key
from franka_wm.policies.planner import allow_recompiles, captures, explores
from franka_wm.seeding import share_of_worlds


class SearchPolicy(TensorDictModuleBase):
    """Encode, search, act.

    Reads the observation keys. Writes `action` (E,) int64, and what a model learns from the search:
    `search_policy` (E, M), the improved policy, and `search_value` (E, 1). The batch size is [E]. No gradient
    is recorded.

    Args:
        search: MCTS or anything with its `search`.
        encode: observation TensorDict of batch size [E] -> latents (E, Z).
        prediction: z -> logits (E, M) and value (E, 1).
        recurrent: see `MCTS.search`.
        observation_keys: what `encode` reads.
        explore: noise at the root and, with PUCT, drawn actions; None follows TorchRL's exploration type.
        model: the module behind the callables, so that collectors find its parameters and move it along. If
            the policy is to be copied, pass bound methods, not closures.
        capture: replay decisions as CUDA graphs, see `PlannerPolicy`; None: where the observations are on CUDA.
        compile: `torch.compile` what is done once for each simulation: read a latent from the tree, `recurrent`, pack
            the answer. The first decision of each number of environments waits for the compiler.

    Raises:
        ValueError, CaptureError: see `PlannerPolicy`.
    """

    def __init__(
        self,
        search: MCTS,
        *,
        encode: Callable[[TensorDictBase], Tensor],
        prediction: Callable[[Tensor], tuple[Tensor, Tensor]],
        recurrent: Recurrent,
        observation_keys: Sequence[str],
        explore: bool | None = None,
        model: nn.Module | None = None,
        capture: bool | None = None,
        compile: bool = False,
    ) -> None:
        super().__init__()
        if compile:
            allow_recompiles()
            recurrent = CompiledRecurrent(recurrent)
        self.in_keys = list(observation_keys)
        self.out_keys = ["action", "search_policy", "search_value"]
        self.search, self.explore, self.model = search, explore, model
        self.encode, self.prediction, self.recurrent = encode, prediction, recurrent
        self.capture, self._graphs = capture, GraphCache()

    @classmethod
    def for_model(
        cls,
        model: WorldModel,
        search: MCTS,
        *,
        explore: bool | None = None,
        capture: bool | None = None,
        compile: bool = False,
    ) -> SearchPolicy:
        """Search with a model that has `prediction` and `recurrent`; other arguments: see the class.

        Raises:
            ValueError: the model lacks one of them, or has another number of actions than the search.
        """
        if not model.has_search:
            raise ValueError(
                f"{type(model).__name__} has no prediction and recurrent: tree search needs a model of discrete "
                "actions such as muzero"
            )
        if model.num_actions != search.num_actions:
            raise ValueError(
                f"the search has num_actions={search.num_actions}, the model {model.num_actions}: make them equal"
            )
        return cls(
            search,
            encode=model.encode,
            prediction=model.prediction,
            recurrent=model.recurrent,
            observation_keys=model.observation_keys,
            explore=explore,
            model=model,
            capture=capture,
            compile=compile,
        )

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action`, `search_policy` and `search_value`.

        Raises:
            ValueError: the batch size is not [E].
        """
        if len(tensordict.batch_size) != 1:
            raise ValueError(f"expected batch size [E], got {list(tensordict.batch_size)}")
        explore = explores(self.explore)
        inputs = tensordict.select(*self.in_keys)
        if not captures(self.capture, inputs[self.in_keys[0]]):
            return tensordict.update(self._decide(inputs, explore))
        modes = (explore, None if self.model is None else self.model.training, share_of_worlds())
        return tensordict.update(
            self._graphs(
                lambda entries: self._decide(entries, explore),
                inputs,
                key=(modes, graph_key(self.search)),
                held=(self.search, self.encode, self.prediction, self.recurrent),
            )
        )

    def _decide(self, tensordict: TensorDictBase, explore: bool) -> TensorDict:
        """What the policy writes."""
        z = self.encode(tensordict)
        logits, value = self.prediction(z)
        found = self.search.search(logits, value, z, self.recurrent, explore=explore)
        return TensorDict(
            {
                "action": found.get("action"),
                "search_policy": found.get("policy"),
                "search_value": found.get("value"),
            },
            batch_size=tensordict.batch_size,
        )
