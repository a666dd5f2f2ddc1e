"""Whether training goes well while it goes, and whether the planner earns its time."""

from __future__ import annotations

import inspect
import math
from typing import TYPE_CHECKING, Any, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor

from franka_wm.evaluation.closed_loop import evaluating
from franka_wm.evaluation.intervals import bootstrap_mean
from franka_wm.evaluation.open_loop import correlation
from franka_wm.evaluation.spectrum import collapse_warning, latent_statistics
from franka_wm.policies import PlannerPolicy

if TYPE_CHECKING:
    from franka_wm.models.base import WorldModel

SAMPLES = 512
"""Latents that :func:`training_diagnostics` looks at, at most."""


@torch.no_grad()
def training_diagnostics(model: WorldModel, batch: TensorDictBase) -> dict[str, float]:
    """Numbers that show a collapse while it happens; cheap enough for every line of a log.

    Changes nothing: neither the model's mode and statistics nor torch's random numbers. Waits for the device.

    Args:
        model: Model of any family.
        batch: Windows [B, H], as ``loss`` takes them: with the model's ``burn_in`` steps in front, if it has any. A
            model with memory sees all of them one after the other.

    Returns:
        ``latent/…``: everything of :func:`~franka_wm.evaluation.spectrum.latent_statistics`, of the first observation
        of up to :data:`SAMPLES` windows, spread over the batch, on ``embed`` where the family has it;
        :func:`~franka_wm.evaluation.spectrum.collapse_warning` reads it. Of families with ``value`` and ``discount``
        on data with rewards ``value/…``: ``mean``; ``td_bias``, mean of V(z_0) − (Σ γ^t r_t + γ^H V(z_H)) over the
        windows that no time limit cuts in two; and ``td_correlation`` between the two. This is calibration against
        the model's own later value and the behaviour in the replay; against true returns see
        ``franka-wm evaluate``. Empty where an encoding is not finite, and of one window alone.
    """
    device = batch.device if batch.device is not None else batch.get("action").device
    keys = model.observation_keys
    apart = max(1, -(-len(batch) // SAMPLES))  # not the first ones: these may be demonstrations
    batch, skipped = cast(TensorDictBase, batch[::apart]), model.burn_in
    devices = [device] if device.type == "cuda" else []
    with evaluating(model), torch.random.fork_rng(devices=devices):
        first = _walked(model, model.encode(batch.select(*keys)[:, 0]), batch, 1, skipped + 1)
        embedded = model.embed(first).float()
        if embedded.shape[0] < 2 or not bool(torch.isfinite(embedded).all()):
            return {}
        out = {f"latent/{name}": value for name, value in latent_statistics(embedded).items()}
        reward = batch.get(("next", "reward"), None)
        if reward is not None and model.has_value:
            reached = batch.get("next").select(*keys)[:, -1]
            if model.has_memory:
                before = _walked(model, first, batch, skipped + 1, batch.shape[1])
                never = torch.zeros(len(batch), 1, dtype=torch.bool, device=before.device)
                last = model.observe(reached, before, batch.get("action")[:, -1], never)
            else:
                last = model.encode(reached)
            window = cast(TensorDictBase, batch[:, skipped:])
            reward, terminated = (window.get(("next", name)) for name in ("reward", "terminated"))
            whole = _within_an_episode(window.get("is_init", None), terminated)
            out |= _value_consistency(
                model, *(x if whole is None else x[whole] for x in (first, last, reward, terminated))
            )
    return out


def _walked(model: WorldModel, z: Tensor, batch: TensorDictBase, start: int, stop: int) -> Tensor:
    """Latents of windows (B, H) at step `stop` - 1 from those z (B, Z) at `start` - 1, of a model with memory."""
    is_init = batch.get("is_init", None)
    if is_init is None:
        is_init = torch.zeros(*batch.shape, 1, dtype=torch.bool, device=z.device)
    seen = batch.select(*model.observation_keys)
    for t in range(start, stop):
        z = model.observe(seen[:, t], z, batch.get("action")[:, t - 1], is_init[:, t])
    return z


def _within_an_episode(is_init: Tensor | None, terminated: Tensor) -> Tensor | None:
    """Windows (B,) that no time limit cuts in two: what follows one is worth nothing to what came before."""
    if is_init is None:
        return None
    return ~(is_init[:, 1:] & ~terminated[:, :-1]).flatten(1).any(1)


def _value_consistency(
    model: WorldModel, first: Tensor, last: Tensor, reward: Tensor, terminated: Tensor
) -> dict[str, float]:
    if not len(first):
        return {}
    value = model.value(first).squeeze(-1).float()
    target = model.value(last).squeeze(-1).float()
    for t in reversed(range(reward.shape[1])):
        ended = terminated[:, t].squeeze(-1)
        target = reward[:, t].squeeze(-1) + model.discount * torch.where(ended, 0.0, target)
    together = correlation(value, target)
    out = {"value/mean": float(value.mean()), "value/td_bias": float((value - target).mean())}
    return out if math.isnan(together) else out | {"value/td_correlation": together}


@torch.no_grad()
def planner_health(policy: PlannerPolicy, observation: TensorDictBase) -> dict[str, object]:
    """How the planner searches, on held-out states; computed in float32, whatever precision the policy plans in.

    Args:
        policy: A :class:`~franka_wm.policies.PlannerPolicy`.
        observation: Batch size [E], with what the policy reads; E ≥ 2.

    Returns:
        ``effective_samples`` (planners that weigh their samples): 1 / Σ w², near 1 when one sample decides all, near
        the number of elites when the scores tell them apart no better than chance. ``gain``: by how much the plan
        found scores above what it started from in the planner's own objective and model; ``better``: share
        of states where it does. Started from means the policy's plan, or doing nothing for families without
        one. ``prior``, ``plan``: the mean scores of both. Means with 95 % bootstrap intervals over the states.
    """
    objective = policy.objective.bind(observation)
    z = policy.encode(observation)
    guide = policy.bound_prior(observation)
    found = policy.planner.plan(z, policy.next, objective, prior=guide, explore=False)
    plan = found.get("best", found.get("plan"))  # iCEM acts by the best one, and its `plan` holds elites, too
    if guide is None:
        before = torch.zeros_like(plan)
    else:
        latent, actions = z, []
        for _ in range(plan.shape[1]):
            actions.append(_deterministic(guide, latent))
            latent = policy.next(latent, actions[-1])
        before = torch.stack(actions, 1)

    def score(plans: Tensor) -> Tensor:
        latents = [z.unsqueeze(1)]
        for t in range(plans.shape[1]):
            latents.append(policy.next(latents[-1], plans[:, t].unsqueeze(1)))
        return objective(torch.stack(latents, 2), plans.unsqueeze(1)).squeeze(1).cpu()

    after, prior = score(plan), score(before)
    out = {
        "gain": bootstrap_mean(after - prior).as_dict(),
        "better": float((after > prior).float().mean()),
        "plan": float(after.mean()),
        "prior": float(prior.mean()),
        "states": z.shape[0],
    }
    if "effective_samples" in found.keys():  # noqa: SIM118
        out["effective_samples"] = bootstrap_mean(found.get("effective_samples").squeeze(-1).cpu()).as_dict()
    return out


def _deterministic(prior: Any, z: Tensor) -> Tensor:
    takes = "deterministic" in inspect.signature(prior).parameters  # a prior need only take the latent
    return prior(z, deterministic=True) if takes else prior(z)


def paired_gain(planner: TensorDictBase, prior: TensorDictBase) -> dict[str, object]:
    """What planning really gains: the difference of returns over the same episodes.

    Args:
        planner, prior: Episodes of :func:`~franka_wm.evaluation.closed_loop.play_episodes` with the same seeds.

    Returns:
        ``return``: mean difference with its 95 % bootstrap interval over pairs; for the arm also
        ``final_distance`` [m].
    """
    names = [name for name in ("return", "final_distance") if name in planner.keys()]  # noqa: SIM118
    return {name: bootstrap_mean((planner.get(name) - prior.get(name)).cpu()).as_dict() for name in names}


def diagnose_training(model: WorldModel, batch: TensorDictBase) -> tuple[dict[str, float], str | None]:
    """Whether latents collapse and values drift: numbers to log, and a warning."""
    numbers = training_diagnostics(model, batch)
    if not numbers:
        if len(batch) < 2:
            return {}, None
        return {}, "the model's latents are no longer finite; lower the learning rate"
    return numbers, collapse_warning(numbers)
