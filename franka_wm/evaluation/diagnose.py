"""All diagnostics of an agent from one set of held-out episodes."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDict
from torch import Tensor

from franka_wm.envs.transformed import arm_of
from franka_wm.evaluation.closed_loop import begin
from franka_wm.evaluation.decoder import (
    SIZES,
    Decoder,
    Imagined,
    decoder_error,
    imagined_beside_real,
    train_decoder,
)
from franka_wm.evaluation.health import paired_gain, planner_health
from franka_wm.evaluation.open_loop import (
    cost_ranks,
    grouped_spearman,
    horizon_error,
    steps_until_forgotten,
    value_calibration,
)
from franka_wm.evaluation.probes import probe
from franka_wm.evaluation.projection import principal_components
from franka_wm.evaluation.protocol import Evaluation
from franka_wm.evaluation.rollouts import (
    ROLLOUT_SEED,
    discounted_returns,
    encode_episodes,
    encoded_validly,
    followed,
    gather_episodes,
    mixture,
)
from franka_wm.evaluation.spectrum import spectrum
from franka_wm.policies import PlannerPolicy
from franka_wm.seeding import derive_seed, seeded

if TYPE_CHECKING:
    from franka_wm.envs import Environment
    from franka_wm.models.base import WorldModel
    from franka_wm.training.load import Agent

EPISODES = 48
"""Held-out episodes of the diagnostics, at most; half of them random, half the model's own."""

SHOWN = 48
"""Number of them whose images are taken."""

HORIZON = 10
IMAGINED = 8
POINTS = 600


@dataclass
class Held:
    """Held-out episodes and what the model makes of them.

    Attributes:
        episodes: Batch size (E, T).
        latents: (E, T + 1, Z).
        valid: (E, T + 1) bool.
        images: (P, T, S, S, 3) uint8 of the first P episodes, or ``None``.
        reaches: Whether success is a small distance to the goal.
    """

    episodes: TensorDict
    latents: Tensor
    valid: Tensor
    images: Tensor | None
    reaches: bool = False


def hold_out(agent: Agent, *, images: bool) -> Held:
    """Plays the episodes that the diagnostics look at: smooth random and the model's own behaviour, in turns."""
    env, model = agent.env, agent.model
    keys = model.observation_keys
    shown = min(SHOWN, env.num_envs) if images and arm_of(env) is not None else 0
    episodes, seen = gather_episodes(
        env,
        mixture(agent.policies, env),
        seed=ROLLOUT_SEED,
        keys=keys,
        image_size=image_size(model),
        images=shown,
        keep=EPISODES,
    )
    with torch.no_grad():
        latents = encode_episodes(model, episodes)
    return Held(episodes, latents, encoded_validly(episodes), seen, _reaches(env))


def _reaches(env: Environment) -> bool:
    """Whether the tool is to come near a goal."""
    arm = arm_of(env)
    return arm is not None and arm.simulation.task.goal_distance


def image_size(model: WorldModel) -> int:
    """Side of the decoder's images [px]: what the model itself reads if that is small, else 64."""
    sizes = [shape[0] for shape in model.image_sizes.values()]
    return min(SIZES, key=lambda size: abs(size - (sizes[0] if sizes else 64)))


def open_loop(agent: Agent, held: Held, *, horizon: int = HORIZON) -> dict[str, Any]:
    """Latent error by horizon and rank correlations; empty for a model without ``next``."""
    model = agent.model
    out: dict[str, Any] = {}
    if model.has_next:
        actions = held.episodes.get("action")
        out |= horizon_error(model, held.latents, actions, horizon=horizon, valid=held.valid)
    if "physical" in held.episodes.keys():  # noqa: SIM118
        positions = held.episodes.get("physical")[..., 14:17]
        ranks = cost_ranks(held.latents[:, :-1], positions, embed=model.embed, valid=held.valid[:, :-1])
        out["rank_correlation"] = ranks["within"]
        out["rank_correlation_across_episodes"] = ranks["across"]
    return out


def probes(held: Held, model: WorldModel) -> dict[str, Any]:
    """R² of joints, velocities, tool, goal, read off the latents; of other environments, of what the model reads."""
    use = held.valid[:, :-1]
    if held.latents.shape[0] < 3:
        return {}
    if "physical" in held.episodes.keys():  # noqa: SIM118
        s = held.episodes.get("physical")
        targets = {
            "joints": s[..., :7],
            "velocities": s[..., 7:14],
            "tool": s[..., 14:17],
            "goal": s[..., 14:17] - s[..., 17:20],
            "tool to goal": s[..., 17:20],
        }
    else:
        targets = {key: held.episodes.get(key) for key in model.observation_sizes}
    return probe(held.latents[:, :-1], targets, valid=use) if targets else {}


def representation(held: Held, model: WorldModel) -> tuple[dict[str, object], dict[str, object]]:
    """Spectrum with collapse warning, and the latents along their two main directions for an image."""
    use = held.valid[:, :-1]
    embedded = model.embed(held.latents[:, :-1])[use].float()
    seen = spectrum(embedded)
    plane = principal_components(embedded.cpu().numpy())
    every = max(1, len(embedded) // POINTS)
    if held.reaches:
        quantity, label = (
            held.episodes.get("physical")[..., 17:20].norm(dim=-1)[use],
            "distance to the goal [m]",
        )
    else:
        quantity, label = held.episodes.get(("next", "reward")).squeeze(-1)[use], "reward"
    latents = {
        "points": plane.points[::every].tolist(),
        "quantity": quantity[::every].tolist(),
        "label": label,
        "explained": plane.explained.tolist(),
    }
    return seen, latents


def calibration(agent: Agent) -> dict[str, Any]:
    """The value against true discounted returns of the policy that it is the value of.

    Played in episodes that are long enough for what is cut off to weigh less than 2 %, since a value looks
    beyond the end of an episode that time cut off. Steps that something else truncates earlier are left out: a
    library's own time limit, an object that has left the table. Empty for families without ``value``, ``policy`` and
    ``discount``; ``not_measured`` says why no step is left.
    """
    from franka_wm.training import build

    model = agent.model
    if not model.has_value or "policy" not in agent.policies:
        return {}
    length = agent.env.config.episode_length
    tail = steps_until_forgotten(model.discount)
    env = build.make_evaluation_env(
        agent.settings, num_envs=min(32, agent.env.num_envs), episode_length=length + tail
    )
    keys = model.observation_keys
    played, _ = gather_episodes(env, agent.policies["policy"], keys=keys)
    done, terminated = (played.get(("next", key)) for key in ("done", "terminated"))
    use = (played.get("valid") & followed(done, terminated, tail))[:, :length]
    if not use.any():
        return {
            "not_measured": f"no episode goes on for {tail} steps, until what follows weighs less than 2 %"
        }
    returns = discounted_returns(played.get(("next", "reward")), done, model.discount)[:, :length]
    with torch.no_grad(), seeded(ROLLOUT_SEED):
        latents = encode_episodes(model, played)[:, :length]
        values = model.value(latents)
    result = value_calibration(values[use].squeeze(-1), returns[use].squeeze(-1))
    if _reaches(env):
        distance = played.get("physical")[:, :length, 17:20].norm(dim=-1)[use].cpu()
        episode = torch.arange(use.shape[0], device=use.device).unsqueeze(1).expand_as(use)[use].cpu()
        groups = torch.stack((episode, episode), -1)
        ranks = grouped_spearman(-values[use].squeeze(-1).cpu(), distance, groups)
        result["rank_with_goal_distance"] = ranks.as_dict()
    return result | {"tail": tail}


def health(agent: Agent, evaluation: Evaluation | None) -> dict[str, Any]:
    """How the planner searches on held-out first states, and what it gains over its prior in truth."""
    out: dict[str, Any] = {}
    planner = agent.policies.get("planner")
    if isinstance(planner, PlannerPolicy):
        with seeded(ROLLOUT_SEED, planner):
            searched = planner_health(planner, begin(agent.env, ROLLOUT_SEED))
        out |= {f"planner {name.replace('_', ' ')}": value for name, value in searched.items()}
    if evaluation is not None and {"planner", "policy"} <= evaluation.episodes.keys():
        gains = paired_gain(evaluation.episodes["planner"], evaluation.episodes["policy"])
        units = {"final_distance": " [m]"}
        out |= {
            f"{name.replace('_', ' ')}, planner minus policy{units.get(name, '')}": v
            for name, v in gains.items()
        }
    return out


def imagine(
    agent: Agent,
    held: Held,
    *,
    announce: Callable[[str], AbstractContextManager[object]] = nullcontext,
) -> tuple[Imagined, Decoder, dict[str, float]] | None:
    """Trains a decoder on the images and draws what the model imagines in an episode that it has not seen.

    Args:
        announce: What tells that the training goes on, called with one line.

    Returns:
        ``None`` without images or without ``next``; else strip and film, the decoder, and its errors on the
        episodes left out (:func:`~franka_wm.evaluation.decoder.decoder_error`).
    """
    if held.images is None or not agent.model.has_next or held.images.shape[0] < 4:
        return None
    images = held.images
    count, length = images.shape[:2]
    device = held.latents.device
    seen = agent.model.embed(held.latents[:count, :length]).float()
    fit = count - max(2, count // 6)
    valid = held.valid[:count, :length].cpu()
    known, unknown = valid.clone(), valid.clone()
    known[fit:], unknown[:fit] = False, False
    latents, drawn = _starts(agent, decoder_size=images.shape[2])
    latents, drawn = torch.cat([seen[known.to(device)], latents]), torch.cat([images[known], drawn])
    with announce(f"training a decoder on {len(drawn)} images; it is used for display only"):
        decoder = train_decoder(latents, drawn)
    errors = decoder_error(decoder, seen[unknown.to(device)], images[unknown])
    world = (
        count - 1 if count % 2 == 0 else count - 2
    )  # odd: the model's own behaviour, which moves with a purpose
    steps = min(IMAGINED, int(valid[world].sum()) - 1)
    actions = held.episodes.get("action")[world, :steps]
    shown = imagined_beside_real(
        agent.model, decoder, held.latents[world, 0], actions, images[world, : steps + 1]
    )
    return shown, decoder, errors


def _starts(agent: Agent, *, decoder_size: int) -> tuple[Tensor, Tensor]:
    """Latents (n, D) and images of the first steps of many more episodes: more poses than a few long ones show."""
    keys = agent.model.observation_keys
    latents, images = [], []
    count = min(64, agent.env.num_envs)
    for k in range(6):
        episodes, seen = gather_episodes(
            agent.env,
            mixture(agent.policies, agent.env),
            seed=derive_seed("diagnostics", 0, "starts", k),
            steps=8,
            keys=keys,
            image_size=decoder_size,
            images=count,
            keep=count,
        )
        assert seen is not None
        with torch.no_grad():
            embedded = agent.model.embed(encode_episodes(agent.model, episodes)[:, :-1]).float()
        use = episodes.get("valid")
        latents.append(embedded[use])
        images.append(seen[use.cpu()])
    return torch.cat(latents), torch.cat(images)
