"""Policies that a TorchRL collector can run: a planner over a world model, and a policy network alone.

Both explore when TorchRL's exploration type is RANDOM, as it is inside a collector, unless told otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial, wraps
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import InteractionType, TensorDictModuleBase
from tensordict.nn.probabilistic import interaction_type
from torch import Tensor, nn

from franka_wm import keys
from franka_wm.models import fused
from franka_wm.models.base import WorldModel
from franka_wm.options import PRECISIONS
from franka_wm.planning.base import Planner, Prior
from franka_wm.planning.objectives import (
    GoalImage,
    Objective,
    RewardPlusValue,
    Score,
    as_objective,
    goal_images,
)
from franka_wm.policies.capture import GraphCache
from franka_wm.policies.graph_key import graph_key
from franka_wm.seeding import share_of_worlds

RECOMPILES = 64
"""For so many shapes a function is compiled: its rounds' numbers of candidates times the numbers of environments."""

CONTEXT = (keys.CONTEXT, "context_action")
"""Entries in which a model's memory travels: the last latent, and the action taken in it."""

Encode = Callable[[TensorDictBase], Tensor]
Observe = Callable[[TensorDictBase, Tensor, Tensor, Tensor], Tensor]


def latent_of(tensordict: TensorDictBase, encode: Encode, observe: Observe | None) -> Tensor:
    """Latents z (E, D) of what a policy is given: with the memory that it carries, if the model has one.

    Raises:
        ValueError: memory without `is_init`, which tells where it ends.
    """
    before = None if observe is None else tensordict.get(keys.CONTEXT, None)
    if observe is None or before is None:
        return encode(tensordict)
    is_init = tensordict.get("is_init", None)
    if is_init is None:
        raise ValueError(
            "a context is carried but is_init is missing: append torchrl.envs.InitTracker to the env"
        )
    return observe(tensordict, before, tensordict.get("context_action"), is_init)


class Guide:
    """A model's policy as the source of a plan's candidates: the first follows its mode, the others draw.

    Early in training, and where entropy weighs much, samples of a policy are far from its mode. Without that candidate
    a plan can be worse than the policy itself.
    """

    def __init__(self, model: WorldModel) -> None:
        self.policy = model.policy

    def act(self, z: Tensor, deterministic: bool = False) -> Tensor:
        """Latents (E, S, D) of S candidates -> actions (E, S, A)."""
        if deterministic:
            return self.policy(z, deterministic=True)
        return torch.cat((self.policy(z[:, :1], deterministic=True), self.policy(z[:, 1:])), dim=1)


class GoalGuide:
    """The same of a policy towards goals, whose images each decision reads.

    Args:
        model: has `goal_policy`, and reads images.
    """

    def __init__(self, model: WorldModel) -> None:
        self.policy = model.goal_policy
        self.reader = GoalImage(model.encode_goal, goals=goal_images(model.image_sizes))
        self.in_keys = self.reader.in_keys

    def bind(self, tensordict: TensorDictBase) -> Prior:
        """What makes the candidates of the present decision, towards its goal."""
        return partial(self.act, self.reader.goal(tensordict))

    def act(self, goal: Tensor, z: Tensor, deterministic: bool = False) -> Tensor:
        """Goals (E, D) and latents (E, S, Z) of S candidates -> actions (E, S, A); of (E, Z) only `deterministic`."""
        if deterministic:
            return self.policy(z, goal, deterministic=True)
        goals = goal.unsqueeze(1).expand(*z.shape[:2], -1)
        first = self.policy(z[:, :1], goals[:, :1], deterministic=True)
        return torch.cat((first, self.policy(z[:, 1:], goals[:, 1:])), dim=1)


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` of latents compiled, for latents that lie in memory as a model returns them: one kind less."""
    allow_recompiles()
    fast = torch.compile(function, dynamic=False)

    @wraps(function, updated=())  # callers look for `deterministic` in its signature
    def call(z: Tensor, *given: Tensor, **options: bool) -> Any:
        return fast(z.contiguous(), *given, **options)

    return call


def allow_recompiles() -> None:
    """Raise torch's limit of programs for a function to `RECOMPILES`, in the whole process.

    After 8 shapes it would run a function as it is: iCEM has as many for one number of environments.
    """
    import torch._dynamo.config as dynamo

    dynamo.recompile_limit = max(dynamo.recompile_limit, RECOMPILES)


def captures(wanted: bool | None, observation: Tensor) -> bool:
    """Whether decisions are captured: where the observations are on CUDA, unless it is not wanted.

    Raises:
        ValueError: it is wanted elsewhere.
    """
    if wanted and not observation.is_cuda:
        raise ValueError(f"capture=True needs observations on CUDA, these are on {observation.device}")
    return observation.is_cuda if wanted is None else wanted


def _guide(model: WorldModel, objective: Objective) -> Prior | GoalGuide | None:
    if model.has_policy:
        return Guide(model).act
    if not model.has_goal_policy or not model.image_sizes:
        return None
    guide = GoalGuide(model)
    return guide if {*guide.in_keys} <= {*objective.in_keys} else None


def explores(explore: bool | None) -> bool:
    """Whether a policy explores: as it was told, else as TorchRL's exploration type says."""
    return interaction_type() is InteractionType.RANDOM if explore is None else explore


class PlannerPolicy(TensorDictModuleBase):
    """Encode, plan, act; the plan travels as an entry of the TensorDict.

    Reads the observation keys, `is_init` (E, 1) bool, and `plan` (E, H, A) if it is there (absent: cold
    start). Writes `action` (E, A) and `plan`. The plan is dropped where `is_init` is True. The batch size is
    [E]. No gradient is recorded.

    A model with memory (`observe`) predicts from a history that its latents hold. Then the last latent and
    the action taken in it travel along, too, as `context` (E, Z) and `context_action` (E, A).

    An objective that depends on the observation (a goal image) has `bind(tensordict)`, which is called at
    every decision. It sees what the policy reads: other entries that it needs are named by its `in_keys`.

    On CUDA the third decision of a kind (so many environments, exploring or not, these settings) is captured as
    a graph, which the later ones replay; see `franka_wm.policies.capture.GraphCache`. Then weights must be
    changed in place, and planner, model and objective must not read values on the host. Settings of planner and
    objective may be changed at any time, at the price of another graph; a goal that changes with every decision is
    best copied into the objective's tensor.

    Args:
        planner: MPPI or anything with its `plan`.
        encode: observation TensorDict of batch size [E] -> latents (E, D).
        next: (z, action) -> next z, any leading dimensions.
        objective: see `franka_wm.planning.objectives`.
        observation_keys: what `encode` reads.
        observe: (observation, latent before, action, is_init) -> latents (E, Z), of a model with memory.
        prior: a policy z -> action for some of the candidates, or one towards goals.
        explore: whether to add noise to the action; None follows TorchRL's exploration type.
        model: the module behind the callables, so that collectors find its parameters and move it along. If
            the policy is to be copied (as collectors do for other processes), pass bound methods and objects,
            not closures, and leave `compile`: compiled functions cannot be sent to another process.
        capture: replay decisions as CUDA graphs; None: where the observations are on CUDA.
        precision: `float32`, or `bfloat16`: the model computes under autocast; plans and actions stay float32.
        compile: `torch.compile` what the planner calls thousands of times: `next`, `prior`, and an objective
            that has `compiled`. Takes a minute at the first decisions of each batch size.

    Raises:
        ValueError: no such precision; or, at a decision, `capture` where the observations are not on CUDA.
        CaptureError: at a decision that cannot be captured.
    """

    def __init__(
        self,
        planner: Planner,
        *,
        encode: Encode,
        next: Callable[[Tensor, Tensor], Tensor],
        objective: Objective | Score,
        observation_keys: Sequence[str],
        observe: Observe | None = None,
        prior: Prior | GoalGuide | None = None,
        explore: bool | None = None,
        model: nn.Module | None = None,
        capture: bool | None = None,
        precision: str = "float32",
        compile: bool = False,
    ) -> None:
        super().__init__()
        if precision not in PRECISIONS:
            raise ValueError(f"precision={precision!r}: must be one of {', '.join(PRECISIONS)}")
        if compile:
            next = compiled(next)
            if prior is not None and not isinstance(prior, GoalGuide):
                prior = compiled(prior)
        self.precision, self._compiles, self._observed = precision, compile, list(observation_keys)
        self.prior = prior
        self.plan_for(objective)
        self.out_keys = ["action", "plan", *(CONTEXT if observe is not None else ())]
        self.planner, self.explore, self.model = planner, explore, model
        self.encode, self.next = encode, next
        self.observe, self.capture = observe, capture
        self._graphs = GraphCache()

    @classmethod
    def for_model(
        cls,
        model: WorldModel,
        planner: Planner,
        *,
        objective: Objective | Score | None = None,
        explore: bool | None = None,
        capture: bool | None = None,
        precision: str = "float32",
        compile: bool = False,
    ) -> PlannerPolicy:
        """Plan with any model that has `encode` and `next`.

        Args:
            objective: rewards plus value of the model, with its `discount`, when None.
            explore, capture, precision, compile: see the class.

        A model with `policy` supplies the prior, see :class:`Guide`; so does one with `goal_policy`, where the
        objective reads images of goals.

        Raises:
            ValueError: the model lacks what the default objective needs.
        """
        if objective is None:
            try:
                objective = RewardPlusValue.of(model)
            except ValueError as error:
                raise ValueError(f"{error}: give an objective") from error
        return cls(
            planner,
            encode=model.encode,
            next=model.next,
            objective=objective,
            observation_keys=model.observation_keys,
            observe=model.observe if model.has_memory else None,
            prior=_guide(model, as_objective(objective)),
            explore=explore,
            model=model,
            capture=capture,
            precision=precision,
            compile=compile,
        )

    def plan_for(self, objective: Objective | Score) -> None:
        """Plan for something else from now on: an objective, or a plain function of trajectories and actions."""
        objective = as_objective(objective)
        self.objective = objective.compiled() if self._compiles else objective
        guide = self.prior.in_keys if isinstance(self.prior, GoalGuide) else ()
        self.in_keys = list(dict.fromkeys((*self._observed, *objective.in_keys, *guide, "is_init")))

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action` and `plan`.

        Raises:
            ValueError: the batch size is not [E], something that is read is missing, or a plan is carried without
                `is_init` to clear it.
        """
        if len(tensordict.batch_size) != 1:
            raise ValueError(f"expected batch size [E], got {list(tensordict.batch_size)}")
        # The last action is read by objectives that weigh smoothness.
        read = (*self.in_keys, "plan", *CONTEXT, "action")
        inputs = TensorDict(
            {key: value for key in read if (value := tensordict.get(key, None)) is not None},
            batch_size=tensordict.batch_size,
        )
        if missing := [str(key) for key in self.in_keys if key not in inputs and key != "is_init"]:
            there = ", ".join(str(key) for key, _ in tensordict.items())
            raise ValueError(
                f"the plan reads {', '.join(missing)}, which is not there, but {there}; is it another environment "
                "than the model's?"
            )
        if "plan" in inputs and "is_init" not in inputs:
            raise ValueError(
                "a plan is carried but is_init is missing: append torchrl.envs.InitTracker to the env"
            )
        explore = explores(self.explore)
        if captures(self.capture, inputs[self.in_keys[0]]):
            training = None if self.model is None else self.model.training
            modes = (explore, self.precision, training, share_of_worlds())
            held = (self.planner, self.encode, self.next, self.objective, self.observe, self.prior)
            decision = self._graphs(
                lambda entries: self._decide(entries, explore),
                inputs,
                key=(modes, graph_key(self.planner), graph_key(self.objective)),
                held=held,
            )
        else:
            decision = self._decide(inputs, explore)
        return tensordict.update(decision)

    def bound_prior(self, tensordict: TensorDictBase) -> Prior | None:
        """The prior of the present decision."""
        return self.prior.bind(tensordict) if isinstance(self.prior, GoalGuide) else self.prior

    def _asked(self, tensordict: TensorDictBase) -> Prior | None:
        """The same for a search: none towards a goal where no candidate is the policy's, as images would be encoded."""
        unread = isinstance(self.prior, GoalGuide) and getattr(self.planner, "num_policy_samples", None) == 0
        return None if unread else self.bound_prior(tensordict)

    def _decide(self, tensordict: TensorDictBase, explore: bool) -> TensorDict:
        """What the policy writes."""
        is_init = tensordict.get("is_init", None)
        low = self.precision == "bfloat16"
        # No cache of cast weights: it would hold tensors of one captured decision into the next.
        device = tensordict.get(self.in_keys[0]).device
        kernels = fused.kernels(self._kernels and fused.ready(device.type), coarse=self.objective.coarse)
        with torch.autocast(device.type, torch.bfloat16, low, False), kernels:
            z = latent_of(tensordict, self.encode, self.observe)
            z = z.float() if low else z
            result = self.planner.plan(
                z,
                self._next if low else self.next,
                self.objective.bind(tensordict),
                prior=self._asked(tensordict),
                previous=tensordict.get("plan", None),
                is_init=is_init,
                explore=explore,
            )
        decision = result.select("action", "plan")
        if self.observe is not None:
            decision.set(keys.CONTEXT, z).set("context_action", result.get("action"))
        return decision

    @property
    def _kernels(self) -> bool:
        """Whether the planner has the option, and leaves it on."""
        return getattr(self.planner, "kernels", False) is not False

    def _next(self, z: Tensor, action: Tensor) -> Tensor:
        """Latents as plans are scored by: in float32, but where kernels may leave them coarse."""
        after = self.next(z, action)
        return after if fused.coarse() else after.float()


class ModelPolicy(TensorDictModuleBase):
    """The policy network alone: observations in, `action` (E, A) out. No gradient is recorded.

    Of a model with memory the last latent and the action taken in it travel along, as with `PlannerPolicy`. Decisions
    are captured as graphs, as there.

    Args:
        encode: observation TensorDict -> latents (..., D).
        policy: called as `policy(z, deterministic=...)` -> actions (..., A); with `goals` as `policy(z, goal, …)`.
        observation_keys: what `encode` reads.
        observe: (observation, latent before, action, is_init) -> latents (E, D), of a model with memory.
        explore: True samples, False takes the mode; None follows TorchRL's exploration type.
        model, capture: see `PlannerPolicy`.
        goals: reads the images of the goal, for a policy towards goals.
    """

    def __init__(
        self,
        *,
        encode: Encode,
        policy: Callable[..., Tensor],
        observation_keys: Sequence[str],
        observe: Observe | None = None,
        explore: bool | None = None,
        model: nn.Module | None = None,
        goals: GoalImage | None = None,
        capture: bool | None = None,
    ) -> None:
        super().__init__()
        remembers = observe is not None
        self.goals = goals
        read = () if goals is None else goals.in_keys
        self.in_keys = [*observation_keys, *read, *(["is_init"] if remembers else [])]
        self.out_keys = ["action", *(CONTEXT if remembers else ())]
        self.encode, self.policy, self.explore, self.model = encode, policy, explore, model
        self.observe, self.capture = observe, capture
        self._graphs = GraphCache()

    @classmethod
    def for_model(
        cls, model: WorldModel, *, explore: bool | None = None, capture: bool | None = None
    ) -> ModelPolicy:
        """The policy of a model that has one, or its policy towards goals."""
        towards = None if model.has_policy else GoalGuide(model)
        return cls(
            encode=model.encode,
            policy=model.policy if towards is None else towards.policy,
            goals=None if towards is None else towards.reader,
            observation_keys=model.observation_keys,
            observe=model.observe if model.has_memory else None,
            explore=explore,
            model=model,
            capture=capture,
        )

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action`."""
        # What `encode` may read, as a planner gives it.
        read = (*self.in_keys, "is_init", *(CONTEXT if self.observe is not None else ()))
        inputs = TensorDict(
            {key: value for key in read if (value := tensordict.get(key, None)) is not None},
            batch_size=tensordict.batch_size,
        )
        explore = explores(self.explore)
        if not captures(self.capture, inputs[self.in_keys[0]]):
            return tensordict.update(self._decide(inputs, explore))
        training = None if self.model is None else self.model.training
        held = (self.encode, self.policy, self.observe, self.goals)
        decision = self._graphs(
            lambda entries: self._decide(entries, explore),
            inputs,
            key=(explore, training, share_of_worlds(), *map(graph_key, held)),
            held=held,
        )
        return tensordict.update(decision)

    def _decide(self, tensordict: TensorDictBase, explore: bool) -> TensorDict:
        """What the policy writes."""
        z = latent_of(tensordict, self.encode, self.observe)
        goal = () if self.goals is None else (self.goals.goal(tensordict),)
        action = self.policy(z, *goal, deterministic=not explore)
        memory = {} if self.observe is None else {keys.CONTEXT: z, "context_action": action}
        return TensorDict({"action": action, **memory}, batch_size=tensordict.batch_size)
