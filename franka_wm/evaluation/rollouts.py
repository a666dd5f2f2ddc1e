"""Held-out experience for the diagnostics: whole episodes as (E, T) batches, and what a model makes of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from franka_wm.envs import Environment, MultiTaskEnv
from franka_wm.envs.transformed import arm_of
from franka_wm.evaluation.closed_loop import begin, evaluating
from franka_wm.seeding import derive_seed, seeded

if TYPE_CHECKING:
    from franka_wm.models.base import WorldModel

ROLLOUT_SEED = derive_seed("diagnostics", 0)
"""Episodes of the diagnostics: neither those of training nor those of the closed loop."""


class Alternating(TensorDictModuleBase):
    """World k follows policy k // ``together`` mod P: one rollout with the behaviour of several policies.

    Args:
        policies: P of them; each acts for all worlds and keeps what it carries along to itself.
        together: So many worlds in a row follow the same one: one of each task, where worlds have several.
    """

    def __init__(self, policies: Sequence[TensorDictModuleBase], *, together: int = 1):
        super().__init__()
        self.together = together
        self.policies = nn.ModuleList(policies)
        self.in_keys = sorted({key for policy in policies for key in policy.in_keys})  # pyright: ignore
        self.out_keys = ["action"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        worlds = torch.arange(tensordict.batch_size[0], device=tensordict.device)
        number = worlds // self.together % len(self.policies)
        chosen, executed = None, tensordict.get("action", None)
        for k, policy in enumerate(self.policies):
            if executed is not None:  # what the policy before has written there was not done
                tensordict.set("action", executed)
            action = policy(tensordict).get("action")
            if chosen is None:
                chosen = action.clone()
            mine = (number == k).view(-1, *[1] * (action.dim() - 1))
            chosen = torch.where(mine, action, chosen)
        assert chosen is not None
        if "context_action" in tensordict:  # a model with memory must remember what was really done
            tensordict.set("context_action", chosen)
        return tensordict.set("action", chosen)


def mixture(policies: dict[str, TensorDictModuleBase], env: Environment) -> TensorDictModuleBase:
    """Half of the worlds move at random, half as the model wants: its policy, or its planner where it has none.

    Of several tasks half of each task's worlds.
    """
    names = ["random", *[name for name in ("policy", "planner") if name in policies][:1]]
    tasks = len(env.envs) if isinstance(env, MultiTaskEnv) else 1
    return Alternating([policies[name] for name in names], together=tasks)


@torch.no_grad()
def gather_episodes(
    env: Environment,
    policy: TensorDictModuleBase,
    *,
    seed: int = ROLLOUT_SEED,
    steps: int | None = None,
    keys: Sequence[str] = (),
    image_size: int | None = None,
    images: int = 0,
    keep: int | None = None,
) -> tuple[TensorDict, Tensor | None]:
    """Plays the first episode of every world and keeps what the diagnostics need.

    Args:
        env: E worlds.
        policy: Run without exploration, its model in evaluation mode.
        seed: Seed of the episodes and of all random numbers: the same call gives the same numbers on a CPU.
        steps: T, at most an episode's length; that if not given.
        keys: Observations to keep.
        image_size: Side of the images to render [px].
        images: Number of worlds whose images are kept, the first ones; the arm only.
        keep: Number of worlds whose steps are kept, the first ones; all E if not given.

    Returns:
        Batch size (E, T), of E worlds that are kept. Root: ``keys``, ``action``, ``is_init``, ``valid`` (E, T) bool
        (step of the first episode), for the arm ``physical`` (E, T, 20): the true state without noise, as under the
        key ``state``; under ``next``: ``keys``, ``reward``, ``terminated``, ``done``, ``physical``. And images of the
        roots, (images, T, S, S, 3) uint8 on the CPU, or ``None``.
    """
    arm = arm_of(env)
    longest = int(env.config.episode_length)
    length = longest if steps is None else min(steps, longest)
    rows, seen = [], []
    running = torch.ones(env.num_envs, dtype=torch.bool, device=env.device)
    with seeded(seed, policy), evaluating(policy), set_exploration_type(ExplorationType.DETERMINISTIC):
        tensordict = begin(env, seed)
        for _ in range(length):
            row: dict[Any, Tensor] = {"valid": running.clone()}
            if arm is not None:
                row["physical"] = arm.simulation.tensors.true_state.clone()
                if image_size and images:
                    seen.append(arm.render(image_size, num_views=images).cpu())
            tensordict, following = env.step_and_maybe_reset(policy(tensordict))
            row |= {key: tensordict.get(key) for key in (*keys, "action", "is_init")}
            row |= {
                ("next", key): tensordict.get(("next", key))
                for key in (*keys, "reward", "terminated", "done")
            }
            if arm is not None:
                row["next", "physical"] = arm.simulation.tensors.next_true_state.clone()
            running &= ~tensordict.get(("next", "done")).squeeze(-1)
            whole = TensorDict(row, batch_size=[env.num_envs], device=env.device)
            # A slice alone would hold on to what it is cut from.
            rows.append(whole if keep is None else whole[:keep].clone())
            tensordict = following
    return cast(TensorDict, torch.stack(rows, 1)), (torch.stack(seen, 1) if seen else None)


@torch.no_grad()
def encode_episodes(model: WorldModel, episodes: TensorDictBase, *, chunk: int = 1024) -> Tensor:
    """Latents of all observations of the episodes, what ended them included.

    A model with memory (``observe``) sees each episode from its beginning, as when it acts.

    Args:
        episodes: Batch size (E, T), of :func:`gather_episodes`.
        chunk: Observations encoded at a time: bounds the memory that images take.

    Returns:
        (E, T + 1, Z).
    """
    keys = model.observation_keys
    last = episodes.get("next").select(*keys)[:, -1:]
    observations = cast(TensorDict, torch.cat([episodes.select(*keys), last], 1))  # pyright: ignore  # (E, T + 1)
    if not model.has_memory:
        flat = cast(TensorDict, observations.flatten(0, 1))
        latents = torch.cat([model.encode(part) for part in flat.split(chunk)])
        return latents.unflatten(0, observations.batch_size)
    z = model.encode(observations[:, 0])
    steps = [z]
    never = torch.zeros(observations.batch_size[0], 1, dtype=torch.bool, device=z.device)
    for t in range(1, observations.batch_size[1]):
        steps.append(model.observe(observations[:, t], steps[-1], episodes.get("action")[:, t - 1], never))
    return torch.stack(steps, 1)


def encoded_validly(episodes: TensorDictBase) -> Tensor:
    """Which latents of :func:`encode_episodes` are of the first episode: (E, T + 1) bool."""
    valid = episodes.get("valid")
    return torch.cat([valid, valid[:, -1:]], 1)


def discounted_returns(reward: Tensor, ended: Tensor, discount: float) -> Tensor:
    """Σ γ^k r_{t+k} to the end of what was recorded, or of the episode.

    Args:
        reward: (E, T, 1).
        ended: (E, T, 1) bool, after that step.
        discount: γ.

    Returns:
        (E, T, 1).
    """
    out = torch.zeros_like(reward)
    following = torch.zeros_like(reward[:, 0])
    for t in reversed(range(reward.shape[1])):
        following = reward[:, t] + discount * torch.where(ended[:, t], 0.0, following)
        out[:, t] = following
    return out


def followed(done: Tensor, terminated: Tensor, steps: int) -> Tensor:
    """Where an episode goes on for so many steps, or to its own end: what was truncated says nothing of what follows.

    Args:
        done, terminated: (E, T, 1) bool, after that step.
        steps: From that step on, itself included.

    Returns:
        (E, T) bool.
    """
    out = torch.zeros_like(done[..., 0])
    known = torch.zeros_like(out[:, 0], dtype=torch.int64)
    for t in reversed(range(done.shape[1])):
        known = torch.where(done[:, t, 0], terminated[:, t, 0] * steps, known) + 1
        out[:, t] = known >= steps
    return out
