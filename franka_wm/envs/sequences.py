"""Action sequences that move an arm."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from tensordict import TensorDict

from franka_wm.errors import UserError
from franka_wm.options import check_whole, is_whole

if TYPE_CHECKING:
    from franka_wm.envs.franka import FrankaEnv


def smooth_actions(
    num_sequences: int,
    length: int,
    action_dim: int,
    *,
    smoothness: float = 0.7,
    device: torch.device | str | None = None,
    generator: torch.Generator | None = None,
) -> torch.Tensor:
    """First-order autoregressive actions in [−1, 1]; white noise would jitter in place.

    a₀ ~ N(0, 1), aₜ = s·aₜ₋₁ + √(1 − s²)·N(0, 1), clipped: every step has the same distribution.

    Args:
        num_sequences, length, action_dim: Shape of the result.
        smoothness: s in [0, 1); 0 is white noise.
        device: Device of the result.
        generator: Source of randomness.

    Returns:
        (num_sequences, length, action_dim) float32.
    """
    check_whole("length", length)
    if not 0.0 <= smoothness < 1.0:
        raise UserError(f"smoothness={smoothness}: must be at least 0 and below 1")
    noise = torch.randn(num_sequences, length, action_dim, device=device, generator=generator)
    actions = torch.empty_like(noise)
    present = noise[:, 0]
    for t in range(length):
        if t:
            present = smoothness * present + math.sqrt(1.0 - smoothness**2) * noise[:, t]
        actions[:, t] = present
    return actions.clamp_(-1.0, 1.0)


def franka_sequences(
    env: FrankaEnv,
    n_sequences: int,
    length: int,
    seed: int = 0,
    smoothness: float = 0.7,
    *,
    max_attempts: int = 4,
) -> TensorDict:
    """Videos of the arm under smooth random actions, each from a fresh reset: data for a world model.

    All worlds of ``env`` play at once, in as many batches as it takes. A sequence in which its world stopped
    being finite, or whose episode ended before its last frame (``terminate_on_success``), is discarded and
    another is drawn, so every frame follows from the one before by the action between them. With
    ``terminate_on_success`` what remains is therefore biased towards failure.

    The result depends on ``seed`` and on the number of worlds. ``env`` is left amid episodes of other seeds:
    reset it before going on. Its ``statistics()`` are as before.

    Args:
        env: The arm. Images come if it observes ``pixels``.
        n_sequences: Sequences wanted, n ≥ 1.
        length: Frames of each, T ≥ 2; at most ``episode_length + 1``.
        seed: Seed of actions, poses and goals.
        smoothness: Smoothness of the actions, in [0, 1): see :func:`smooth_actions`.
        max_attempts: Gives up after so many times the batches that would do if none were discarded.

    Returns:
        A TensorDict of batch size (n,) on the environment's device:

        - ``video`` (n, T, 3, H, W) uint8. Bytes, because float would take four times the memory of what is
          mostly memory: ``video.float() / 255`` is in [0, 1]. In memory the channels are last, so that
          ``video.movedim(2, -1)``, this package's ``pixels``, costs no copy.
        - ``action`` (n, T − 1, A) in [−1, 1]: ``action[:, t]`` leads from frame t to frame t + 1.
        - ``joint_q`` (n, T, 7) [rad] and ``tool`` (n, T, 3) [m].

    Raises:
        UserError: If a size cannot be had, or too many sequences are discarded; says what to change.
    """
    check_whole("n_sequences", n_sequences)
    longest = env.config.episode_length + 1
    if not is_whole(length) or not 2 <= length <= longest:
        raise UserError(
            f"length={length!r}: must be from 2 to {longest} frames, one more than episode_length="
            f"{env.config.episode_length}; for longer sequences raise episode_length"
        )
    check_whole("max_attempts", max_attempts)
    from franka_wm.envs.simulation import STATISTICS  # late: this module's other function needs no simulator

    # Drawn on the host, so that every device plays the same sequences.
    generator = torch.Generator().manual_seed(seed)
    statistics = env.simulation.tensors.statistics
    before, count = statistics.clone(), statistics[:, STATISTICS.index("nonfinite")]
    kept: dict[str, list[torch.Tensor]] = {"action": [], "joint_q": [], "tool": []}
    if "pixels" in env.config.observations:
        kept["video"] = []
    missing, tried, broken, ended = n_sequences, 0, 0, 0
    allowed = max_attempts * math.ceil(n_sequences / env.num_envs)
    for _ in range(allowed):
        actions = smooth_actions(
            env.num_envs, length - 1, env.action_dim, smoothness=smoothness, generator=generator
        ).to(env.device)
        reset_seed = int(torch.randint(2**31 - 1, (1,), generator=generator))
        nonfinite = count.clone()
        rollout = env.rollout_actions(actions, seed=reset_seed)
        # A broken world is put back and counted by the environment: its frames look finite.
        bad = (count > nonfinite) | ~torch.isfinite(rollout["state"]).flatten(1).all(1)
        cut = rollout.get("done")[:, :-1].flatten(1).any(1) & ~bad
        good = (~(bad | cut)).nonzero().squeeze(-1)[:missing]
        tried, broken, ended = tried + env.num_envs, broken + int(bad.sum()), ended + int(cut.sum())
        for key, parts in kept.items():
            parts.append((actions if key == "action" else rollout[key])[good])
        missing -= good.numel()
        if not missing:
            break
    statistics.copy_(before)
    if missing:
        remedies = []
        if broken:
            remedies.append(
                f"{broken} stopped being finite: lower target_ke or action_scale, "
                "or raise substeps or solver_iterations"
            )
        if ended:
            keep = "set terminate_on_success=false, or " if env.config.terminate_on_success else ""
            remedies.append(f"{ended} ended early: {keep}ask for a shorter length")
        raise UserError(
            f"{broken + ended} of {tried} sequences were discarded and {missing} of {n_sequences} are still missing: "
            + "; ".join(remedies)
        )
    out = {key: torch.cat(parts) for key, parts in kept.items()}
    if "video" in out:
        out["video"] = out["video"].movedim(-1, 2)
    return TensorDict(out, batch_size=[n_sequences], device=env.device)


def play_actions(env: FrankaEnv, actions: torch.Tensor, seed: int | None) -> TensorDict:
    """What :meth:`FrankaEnv.rollout_actions` says."""
    shape = tuple(actions.shape)
    if len(shape) != 3 or not shape[1] or (shape[0], shape[2]) != (env.num_envs, env.action_dim):
        raise UserError(f"actions has shape {shape}; it must be ({env.num_envs}, T, {env.action_dim})")
    env.reset(seed=seed)
    t, renderer = env.simulation.tensors, env.simulation.renderer
    states, videos, rewards, dones = [t.state.clone()], [], [], []
    if "pixels" in renderer.images:
        videos.append(renderer.images["pixels"].clone())
    for action in actions.unbind(1):
        with env.restarting():
            step = env._step(TensorDict({"action": action}, batch_size=env.batch_size))
        rewards.append(step["reward"])
        dones.append(step["done"])
        states.append(t.next_state.clone())
        if "pixels" in renderer.images:
            videos.append(renderer.next_images["pixels"].clone())
    state = torch.stack(states, 1)
    out = {
        "state": state,
        "joint_q": state[..., :7],
        "tool": state[..., 14:17],
        "reward": torch.stack(rewards, 1),
        "done": torch.stack(dones, 1),
    }
    if videos:
        out["video"] = torch.stack(videos, 1)
    return TensorDict(out, batch_size=env.batch_size)
